// What the page says about the connection, in words for a person. No DOM here.

const REASONS = {
  'not-found': 'Stream not found',
  busy: 'The server is full',
  refused: 'The server refused',
  forbidden: 'Not allowed',
  unreachable: 'Server not reachable',
  timeout: 'No connection',
  disconnected: 'Connection lost',
};

const STALLED_MS = 3000;

/**
 * @param {object} facts
 * @param {string} facts.stream name of the stream
 * @param {{state: string, reason: ?string, detail: ?string}} facts.whep the WhepClient's fields
 * @param {?number} facts.retryInS seconds to the next attempt while waiting
 * @param {?{state: string, detail: ?string}} facts.source from StreamEvents
 * @param {boolean} facts.hasPicture something has been drawn
 * @param {number} facts.silentMs time since the last frame
 * @returns {{level: string, title: string, detail: string, canRetry: boolean}} level: ok, busy, warning or error
 */
export function describe({ stream, whep, retryInS, source, hasPicture, silentMs }) {
  const say = (level, title, detail = '', canRetry = false) => ({ level, title, detail, canRetry });
  if (whep.state === 'idle') return say('busy', 'Stopped', '', true);
  if (whep.state === 'unsupported') {
    return say('error', 'No video in this browser',
      `The stream is H.264 or VP8 and ${whep.detail}. Current Chrome, Edge, Safari and Firefox can play it.`);
  }
  if (whep.state === 'waiting') {
    const when = `Reconnecting in ${Math.max(0, Math.ceil(retryInS))} s.`;
    const why = whep.reason === 'not-found' ? `There is no stream named “${stream}” here.` : sentence(whep.detail);
    return say('error', REASONS[whep.reason] ?? 'Connection lost', `${why} ${when}`.trim(), true);
  }
  if (whep.state === 'connecting') return say('busy', 'Connecting…');
  return describeSource(say, source, hasPicture, silentMs);
}

function describeSource(say, source, hasPicture, silentMs) {
  const detail = sentence(source?.detail);
  const still = hasPicture ? 'The picture stands still until it is back.' : '';
  switch (source?.state) {
    case 'lost': return say('warning', 'Source lost', `${still} ${detail}`.trim());
    case 'failed': return say('error', 'Source failed', detail);
    case 'connecting': return say(hasPicture ? 'warning' : 'busy', 'Waiting for the source', detail);
    case 'idle': return say('warning', 'No source', 'This stream has no camera yet.');
  }
  if (!hasPicture) return say('busy', 'Waiting for the first picture…');
  if (silentMs > STALLED_MS) return say('warning', 'Picture stopped', 'No new picture has arrived for some seconds.');
  return say('ok', 'Live');
}

/** An error message of the service ("lower case, no full stop") as a sentence; an address at its head stays as it is. */
function sentence(text) {
  if (!text) return '';
  const start = /^\w+:\/\//.test(text) ? text[0] : text[0].toUpperCase();
  return `${start}${text.slice(1)}${/[.!?…]$/.test(text) ? '' : '.'}`;
}
