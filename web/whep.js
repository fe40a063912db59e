// WHEP client (draft-ietf-wish-whep): one recvonly session that is made again for as long as it is wanted.

import { backoffMs, problemText } from './service.js';

const GATHERING_MS = 3000;     // host candidates come at once; a dead STUN or TURN server must not hold up the offer
const ANSWER_MS = 10_000;
const CONNECT_MS = 15_000;     // from the answer to the first connected state
const DISCONNECTED_MS = 4000;  // ICE often recovers by itself from a short break
const STABLE_MS = 10_000;      // connected for so long: the next failure starts with a short pause again
const LONGEST_PAUSE_MS = 60_000;

/** Why a session ended. reason: not-found, busy, refused, unreachable, timeout, disconnected or no-h264. */
class SessionError extends Error {
  constructor(reason, message, retryAfterMs = null) {
    super(message);
    this.reason = reason;
    this.retryAfterMs = retryAfterMs;
  }
}

/**
 * Events: `state` on every change of the fields below, `stream` with `detail` = MediaStream when media arrives, `drop`
 * right before that stream ends.
 *
 * state: `idle`, `connecting`, `connected`, `waiting` (tries again at `retryAt`), `unsupported` (will not try again).
 */
export class WhepClient extends EventTarget {
  state = 'idle';
  /** Why it is waiting or unsupported: a reason of SessionError, and a sentence of the server's or the browser's. */
  reason = null;
  detail = null;
  /** performance.now() of the next attempt while waiting. */
  retryAt = null;
  /** @type {RTCPeerConnection | null} */
  peer = null;

  #url;
  #sessionUrl = null;
  #attempt = 0;
  #timer = null;
  #abort = null;
  #connectedAt = null;

  /** @param {string} url POST /whep/{stream} */
  constructor(url) {
    super();
    this.#url = url;
  }

  /** Connects now; does nothing while connecting or connected. */
  start() {
    if (['connecting', 'connected'].includes(this.state)) return;
    clearTimeout(this.#timer);
    this.#connect();
  }

  /** Ends the session and stays away. Safe to call while the page goes away. */
  close() {
    this.#drop();
    this.#enter('idle');
  }

  /** Makes a new session at once if no media comes in any more, without waiting for ICE to notice. */
  async verify(withinMs = 1500) {
    const peer = this.peer;
    if (this.state !== 'connected') return;
    const before = await bytesReceived(peer);
    await new Promise((resolve) => setTimeout(resolve, withinMs));
    if (this.peer !== peer || this.state !== 'connected' || await bytesReceived(peer) !== before) return;
    if (this.peer !== peer) return;
    this.#drop();
    this.#connect();
  }

  async #connect() {
    this.#attempt += 1;
    this.#abort = new AbortController();
    const { signal } = this.#abort;
    this.#enter('connecting');
    try {
      const servers = await this.#iceServers(signal);
      const peer = this.#createPeer(servers, signal);
      await peer.setLocalDescription(await peer.createOffer());
      await gathered(peer, GATHERING_MS);
      signal.throwIfAborted();
      const answer = await this.#post(peer.localDescription.sdp, signal);
      await peer.setRemoteDescription({ type: 'answer', sdp: answer });
      if (peer.getTransceivers()[0].currentDirection !== 'recvonly') {
        throw new SessionError('no-h264', 'the server and this browser share no video codec');
      }
      this.#limit(CONNECT_MS, signal, 'no connection was made: a firewall may block WebRTC (UDP)');
    } catch (error) {
      if (!signal.aborted) this.#fail(error);
    }
  }

  #createPeer(iceServers, signal) {
    const peer = this.peer = new RTCPeerConnection({ iceServers, bundlePolicy: 'max-bundle' });
    const video = peer.addTransceiver('video', { direction: 'recvonly' });
    preferH264(video);
    shortenJitterBuffer(video.receiver);
    peer.addEventListener('track', ({ streams, track }) => {
      const stream = streams[0] ?? new MediaStream([track]);
      this.dispatchEvent(new CustomEvent('stream', { detail: stream }));
    });
    let brokenFor = null;
    peer.addEventListener('connectionstatechange', () => {
      if (signal.aborted) return;
      clearTimeout(brokenFor);
      const broken = () => signal.aborted || this.#fail(new SessionError('disconnected', 'the connection broke'));
      if (peer.connectionState === 'connected') this.#connected();
      if (peer.connectionState === 'disconnected') brokenFor = setTimeout(broken, DISCONNECTED_MS);
      if (['failed', 'closed'].includes(peer.connectionState)) broken();
    });
    return peer;
  }

  #connected() {
    clearTimeout(this.#timer);
    this.#connectedAt ??= performance.now();
    if (this.state !== 'connected') this.#enter('connected');
  }

  /** ICE servers must be known before gathering begins; a server that does not tell them to OPTIONS needs none. */
  async #iceServers(signal) {
    try {
      const response = await fetch(this.#url, { method: 'OPTIONS', signal: anySignal(signal, ANSWER_MS) });
      return iceServersFromLink(response.headers.get('Link'));
    } catch {
      signal.throwIfAborted();
      return [];   // POST will say what is wrong
    }
  }

  async #post(sdp, signal) {
    let response;
    try {
      response = await fetch(this.#url, {
        method: 'POST', headers: { 'Content-Type': 'application/sdp', Accept: 'application/sdp' }, body: sdp,
        signal: anySignal(signal, ANSWER_MS),
      });
    } catch (error) {
      signal.throwIfAborted();
      if (error.name === 'TimeoutError') throw new SessionError('timeout', 'the server did not answer');
      throw new SessionError('unreachable', 'the server cannot be reached');
    }
    if (!response.ok) throw await refusal(response);
    const location = response.headers.get('Location');
    const session = location && new URL(location, response.url).href;
    const answer = await response.text();
    if (signal.aborted) forget(session);   // closed while the server answered
    signal.throwIfAborted();
    this.#sessionUrl = session;
    return answer;
  }

  #limit(ms, signal, message) {
    if (this.state === 'connected') return;
    this.#timer = setTimeout(() => signal.aborted || this.#fail(new SessionError('timeout', message)), ms);
  }

  #fail(error) {
    if (this.#connectedAt !== null && performance.now() - this.#connectedAt > STABLE_MS) this.#attempt = 1;
    this.#drop();
    this.reason = error.reason ?? 'refused';
    this.detail = error.message;
    if (this.reason === 'no-h264') {
      this.#enter('unsupported', this.reason, this.detail);
      return;
    }
    const pause = Math.min(LONGEST_PAUSE_MS, Math.max(error.retryAfterMs ?? 0, backoffMs(Math.max(1, this.#attempt))));
    this.retryAt = performance.now() + pause;
    this.#timer = setTimeout(() => this.#connect(), pause);
    this.#enter('waiting', this.reason, this.detail, this.retryAt);
  }

  /** Lets go of the session in both directions; the server is told, even while the page unloads. */
  #drop() {
    clearTimeout(this.#timer);
    this.#abort?.abort();
    if (this.peer) this.dispatchEvent(new Event('drop'));
    this.peer?.close();
    this.peer = null;
    this.#connectedAt = null;
    forget(this.#sessionUrl);
    this.#sessionUrl = null;
  }

  #enter(state, reason = null, detail = null, retryAt = null) {
    Object.assign(this, { state, reason, detail, retryAt });
    this.dispatchEvent(new Event('state'));
  }
}

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

async function refusal(response) {
  const text = await problemText(response);
  const pause = retryAfterMs(response.headers.get('Retry-After'));
  if ([404, 410].includes(response.status)) return new SessionError('not-found', text, pause);
  if ([429, 503].includes(response.status)) return new SessionError('busy', text, pause);
  if (response.status === 406) return new SessionError('no-h264', text);
  if ([502, 504].includes(response.status)) return new SessionError('unreachable', text, pause);   // a proxy's words
  return new SessionError('refused', text, pause);
}

function preferH264(transceiver) {
  const codecs = RTCRtpReceiver.getCapabilities?.('video')?.codecs;
  if (!codecs || !transceiver.setCodecPreferences) return;   // an old browser: the server chooses
  const isH264 = (codec) => codec.mimeType.toLowerCase() === 'video/h264';
  if (!codecs.some(isH264)) throw new SessionError('no-h264', 'this browser does not receive H.264 video');
  transceiver.setCodecPreferences([...codecs.filter(isH264), ...codecs.filter((codec) => !isH264(codec))]);
}

/** Live and interactive: show a frame as soon as it is whole, rather than smoothly and late. */
function shortenJitterBuffer(receiver) {
  if ('jitterBufferTarget' in receiver) receiver.jitterBufferTarget = 0;
  else if ('playoutDelayHint' in receiver) receiver.playoutDelayHint = 0;
}

function gathered(peer, limitMs) {
  return new Promise((resolve) => {
    const check = () => peer.iceGatheringState === 'complete' && resolve();
    peer.addEventListener('icegatheringstatechange', check);
    setTimeout(resolve, limitMs);
    check();
  });
}

async function bytesReceived(peer) {
  let bytes = 0;
  for (const report of (await peer.getStats()).values()) if (report.type === 'inbound-rtp') bytes += report.bytesReceived;
  return bytes;
}

function anySignal(signal, timeoutMs) {
  return AbortSignal.any ? AbortSignal.any([signal, AbortSignal.timeout(timeoutMs)]) : signal;
}

function forget(sessionUrl) {
  // keepalive outlives the page; whether it arrives matters to nobody here, the server also times sessions out
  if (sessionUrl) fetch(sessionUrl, { method: 'DELETE', keepalive: true }).catch(() => {});
}
