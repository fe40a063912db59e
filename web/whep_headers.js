// Header fields of WHEP answers. No DOM here.

/** ICE servers of a WHEP Link header: `<turn:host>; rel="ice-server"; username="u"; credential="c"`, comma-separated. */
export function iceServersFromLink(header) {
  const servers = [];
  for (const [, urls, parameters] of (header ?? '').matchAll(/<([^>]*)>([^<]*)/g)) {
    const of = (name) => {
      const match = parameters.match(new RegExp(`(?:^|[;\\s])${name}\\s*=\\s*(?:"([^"]*)"|([^";,\\s]*))`, 'i'));
      return match?.[1] ?? match?.[2];
    };
    if (of('rel') !== 'ice-server') continue;
    const username = of('username');
    servers.push(username === undefined ? { urls } : { urls, username, credential: of('credential') });
  }
  return servers;
}

/** Milliseconds of a Retry-After header (seconds or an HTTP date), or null. */
export function retryAfterMs(header, now = Date.now()) {
  if (!header) return null;
  const ms = /^\s*\d+\s*$/.test(header) ? Number(header) * 1000 : Date.parse(header) - now;
  return Number.isFinite(ms) ? Math.max(0, ms) : null;
}
