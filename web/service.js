// Addresses of the service, relative to this file so that a reverse proxy may mount it under any path, and its errors.

const ROOT = new URL('..', import.meta.url);

export const streamsUrl = () => new URL('api/streams', ROOT).href;
export const viewUrl = (stream) => new URL(`view/${encodeURIComponent(stream)}`, ROOT).href;
export const controlUrl = (stream) => new URL(`control/${encodeURIComponent(stream)}`, ROOT).href;
export const whepUrl = (stream) => new URL(`whep/${encodeURIComponent(stream)}`, ROOT).href;

export function eventsUrl(stream) {
  const url = new URL(`api/streams/${encodeURIComponent(stream)}/events`, ROOT);
  url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
  return url.href;
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
