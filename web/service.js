// Addresses of the service, relative to this file so that a reverse proxy may mount it under any path, and its errors.

const ROOT = new URL('..', import.meta.url);

export const streamsUrl = () => new URL('api/streams', ROOT).href;
export const viewUrl = (stream) => new URL(`view/${encodeURIComponent(stream)}`, ROOT).href;
export const controlUrl = (stream) => new URL(`control/${encodeURIComponent(stream)}`, ROOT).href;

/** With what the page's own address asks for: `?rendition=` the one to send, `?at_most=` the best one to send. */
export function whepUrl(stream, pageQuery = globalThis.location?.search ?? '') {
  const url = new URL(`whep/${encodeURIComponent(stream)}`, ROOT);
  for (const name of ['rendition', 'at_most']) {
    const value = new URLSearchParams(pageQuery).get(name);
    if (value) url.searchParams.set(name, value);
  }
  return url.href;
}

/** Every way to watch the stream. */
export async function playback(stream) {
  const response = await fetch(new URL(`api/streams/${encodeURIComponent(stream)}/playback`, ROOT), { headers: authorized() });
  return response.ok ? response.json() : [];
}

export function eventsUrl(stream) {
  const url = new URL(`api/streams/${encodeURIComponent(stream)}/events`, ROOT);
  url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
  return url.href;
}

/**
 * The bearer token that entitles this tab, or null. It comes in the fragment of the page's address (`#token=…`), which no server is
 * told, and is taken out of the address bar at once.
 */
export const token = globalThis.location ? takeToken() : null;

/** Headers of a request to the service. */
export const authorized = (headers = {}, bearer = token) => (bearer ? { ...headers, Authorization: `Bearer ${bearer}` } : headers);

/** The protocols of a WebSocket to the service: a browser has no other way to name a token that stays out of logs. */
export const socketProtocols = (bearer = token) => (bearer ? [`bearer.${bearer}`] : []);

function takeToken() {
  const fragment = new URLSearchParams(location.hash.slice(1));
  const given = fragment.get('token');
  try {
    if (given === null) return sessionStorage.getItem('mr360 token');
    fragment.delete('token');
    const rest = fragment.size ? `#${fragment}` : '';
    history.replaceState(history.state, '', `${location.pathname}${location.search}${rest}`);
    sessionStorage.setItem('mr360 token', given);
  } catch {
    // no storage in this browser: the token lasts as long as the page
  }
  return given;
}

/** One sentence of what a response with an error status says (RFC 9457 problem JSON, else its status). */
export async function problemText(response) {
  try {
    const problem = await response.json();
    const text = problem.detail ?? problem.title;
    if (typeof text === 'string' && text) return text;
  } catch {
    // no JSON in it: the status has to do
  }
  return `${response.status} ${response.statusText}`.trim();
}

/** Pause before attempt number `attempt` (from 1), in ms: 1, 2, 4, 8, 10, 10, … s, ±20 % so that a crowd spreads out. */
export function backoffMs(attempt, random = Math.random()) {
  return Math.min(10_000, 1000 * 2 ** (attempt - 1)) * (0.8 + 0.4 * random);
}
