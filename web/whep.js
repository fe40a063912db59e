// WHEP client (draft-ietf-wish-whep): one recvonly session that is made again for as long as it is wanted.

import { withinReach } from './decoding.js';
import { restartFragment, restartedAnswer } from './ice_restart.js';
import { bytesReceived, describeLocally, receivingPeer, somethingReceived } from './peer.js';
import { authorized, backoffMs, problemText } from './service.js';
import { iceServersFromLink, retryAfterMs } from './whep_headers.js';

const GATHERING_MS = 3000;     // host candidates come at once; a dead STUN or TURN server must not hold up the offer
const ANSWER_MS = 10_000;
const CONNECT_MS = 15_000;     // from the answer to the first connected state
const DISCONNECTED_MS = 2000;  // ICE often recovers by itself from a short break; then it is restarted
const RESTART_MS = 8000;       // for that, before there is a new session
const RESTART_PAUSE_MS = 500;
const RESTART_GATHERING_MS = 500;
const STABLE_MS = 10_000;      // connected for so long: the next failure starts with a short pause again
const LONGEST_PAUSE_MS = 60_000;

/** Why a session ended. reason: not-found, busy, forbidden, refused, unreachable, timeout, disconnected or no-codec. */
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
  #playback;
  #sessionUrl = null;
  #attempt = 0;
  #timer = null;
  #abort = null;
  #connectedAt = null;
  #stream = null;
  #restarting = false;

  /**
   * @param {string} url POST /whep/{stream}
   * @param {() => Promise<object[]>} playback every way to watch it, from which a rendition that this device decodes is chosen
   */
  constructor(url, playback = async () => []) {
    super();
    this.#url = url;
    this.#playback = playback;
    globalThis.addEventListener?.('online', () => this.#restartIce());     // most likely over another network
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

  /** Looks for another way at once if no media comes in any more, without waiting for ICE to notice. */
  async verify(withinMs = 1500) {
    const peer = this.peer;
    if (this.state !== 'connected') return;
    const before = await bytesReceived(peer);
    await new Promise((resolve) => setTimeout(resolve, withinMs));
    if (this.peer !== peer || this.state !== 'connected' || await bytesReceived(peer) !== before) return;
    if (this.peer === peer) await this.#restartIce();
  }

  async #connect() {
    this.#attempt += 1;
    this.#abort = new AbortController();
    const { signal } = this.#abort;
    this.#enter('connecting');
    try {
      const asking = withinReach(this.#url, this.#playback);
      const servers = await this.#iceServers(signal) ?? [];
      const peer = this.#createPeer(servers, signal);
      const offer = await describeLocally(peer, await peer.createOffer(), GATHERING_MS);
      signal.throwIfAborted();
      const answer = await this.#post(await asking, offer, signal);
      await peer.setRemoteDescription({ type: 'answer', sdp: answer });
      if (peer.getTransceivers()[0].currentDirection !== 'recvonly') {
        throw new SessionError('no-codec', 'the server and this browser share no video codec');
      }
      this.#limit(CONNECT_MS, signal, 'no connection was made: a firewall may block WebRTC (UDP)');
    } catch (error) {
      if (!signal.aborted) this.#fail(error);
    }
  }

  #createPeer(iceServers, signal) {
    const peer = this.peer = receivingPeer(iceServers);
    peer.addEventListener('track', ({ streams, track }) => this.#addTrack(streams[0], track));
    let brokenFor = null;
    peer.addEventListener('connectionstatechange', () => {
      if (signal.aborted) return;
      clearTimeout(brokenFor);
      if (peer.connectionState === 'connected') this.#connected();
      if (peer.connectionState === 'disconnected') brokenFor = setTimeout(() => this.#restartIce(), DISCONNECTED_MS);
      if (['failed', 'closed'].includes(peer.connectionState)) this.#broken(signal);
    });
    return peer;
  }

  /** Picture and sound come in one MediaStream, one after the other. */
  #addTrack(stream, track) {
    if (this.#stream && (!stream || stream === this.#stream)) {
      if (!stream) this.#stream.addTrack(track);
      return;
    }
    this.#stream = stream ?? new MediaStream([track]);
    this.dispatchEvent(new CustomEvent('stream', { detail: this.#stream }));
  }

  #broken(signal) {
    if (!signal.aborted) this.#fail(new SessionError('disconnected', 'the connection broke'));
  }

  /**
   * Looks for a new path for the session's media, as after a change of the network; the old one is used until there is one. If
   * nothing is found, the session has ended.
   */
  async #restartIce() {
    const { peer } = this;
    if (this.state !== 'connected' || this.#restarting || !this.#sessionUrl) return;
    const { signal } = this.#abort;
    const limit = anySignal(signal, RESTART_MS);
    this.#restarting = true;
    try {
      const before = await bytesReceived(peer);
      while (!await this.#negotiateRestart(peer, limit)) {
        await new Promise((resolve) => setTimeout(resolve, RESTART_PAUSE_MS));
        if (await bytesReceived(peer) !== before) return;     // the old path is back
      }
      await somethingReceived(peer, limit);
    } catch (error) {
      if (!signal.aborted && error.reason === 'not-found') this.#connectAnew();
      else this.#broken(signal);
    } finally {
      this.#restarting = false;
    }
  }

  /** At once: the service is there, and knows nothing of the session. */
  #connectAnew() {
    this.#drop();
    this.#connect();
  }

  /** False if the server cannot be reached: the network may be gone for a moment. */
  async #negotiateRestart(peer, signal) {
    const iceServers = await this.#iceServers(signal);      // the credentials may have expired
    if (iceServers) peer.setConfiguration({ ...peer.getConfiguration(), iceServers });
    const offer = await describeLocally(peer, await peer.createOffer({ iceRestart: true }), RESTART_GATHERING_MS);
    signal.throwIfAborted();
    const response = await fetch(this.#sessionUrl, {
      method: 'PATCH', body: restartFragment(offer), signal,
      headers: authorized({ 'Content-Type': 'application/trickle-ice-sdpfrag', 'If-Match': '*' }),
    }).catch(() => signal.throwIfAborted());
    if (!response) return false;
    if (response.status !== 200) throw await refusal(response);
    const sdp = restartedAnswer(peer.currentRemoteDescription.sdp, await response.text());
    signal.throwIfAborted();
    await peer.setRemoteDescription({ type: 'answer', sdp });
    return true;
  }

  #connected() {
    clearTimeout(this.#timer);
    this.#connectedAt ??= performance.now();
    if (this.state !== 'connected') this.#enter('connected');
  }

  /** ICE servers must be known before gathering begins; a server that does not tell them to OPTIONS needs none. */
  async #iceServers(signal) {
    try {
      const response = await fetch(this.#url, { method: 'OPTIONS', headers: authorized(), signal: anySignal(signal, ANSWER_MS) });
      return iceServersFromLink(response.headers.get('Link'));
    } catch {
      signal.throwIfAborted();
      return null;   // POST will say what is wrong
    }
  }

  async #post(url, sdp, signal) {
    let response;
    try {
      response = await fetch(url, {
        method: 'POST', headers: authorized({ 'Content-Type': 'application/sdp', Accept: 'application/sdp' }), body: sdp,
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
    if (this.reason === 'no-codec') {
      this.#enter('unsupported', this.reason, this.detail);
      return;
    }
    const pause = Math.min(LONGEST_PAUSE_MS, Math.max(spread(error.retryAfterMs), backoffMs(Math.max(1, this.#attempt))));
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
    this.#stream = null;
    forget(this.#sessionUrl);
    this.#sessionUrl = null;
  }

  #enter(state, reason = null, detail = null, retryAt = null) {
    Object.assign(this, { state, reason, detail, retryAt });
    this.dispatchEvent(new Event('state'));
  }
}

async function refusal(response) {
  const text = await problemText(response);
  const pause = retryAfterMs(response.headers.get('Retry-After'));
  if ([404, 410].includes(response.status)) return new SessionError('not-found', text, pause);
  if ([429, 503].includes(response.status)) return new SessionError('busy', text, pause);
  if ([401, 403].includes(response.status)) return new SessionError('forbidden', text, pause);
  if (response.status === 406) return new SessionError('no-codec', text);
  if ([502, 504].includes(response.status)) return new SessionError('unreachable', text, pause);   // a proxy's words
  return new SessionError('refused', text, pause);
}

function anySignal(signal, timeoutMs) {
  return AbortSignal.any ? AbortSignal.any([signal, AbortSignal.timeout(timeoutMs)]) : signal;
}

function forget(sessionUrl) {
  // keepalive outlives the page; whether it arrives matters to nobody here, the server also times sessions out
  if (sessionUrl) fetch(sessionUrl, { method: 'DELETE', headers: authorized(), keepalive: true }).catch(() => {});
}

/** What a crowd is told at the same time it does not do at the same time. */
function spread(retryAfterMs) {
  return (retryAfterMs ?? 0) * (1 + 0.4 * Math.random());
}
