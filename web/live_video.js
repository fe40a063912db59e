// Plays a stream into a video element as it comes, and says in words how that goes.

import { playback, whepUrl } from './service.js';
import { describe } from './status.js';
import { VideoFrames, isFed } from './video_frames.js';
import { WhepClient } from './whep.js';

/** Events: `change` when status() may say something else now. */
export class LiveVideo extends EventTarget {
  #stream;
  #video;
  #events;
  #frames;
  #playingSince = 0;

  /**
   * @param {HTMLVideoElement} video
   * @param {string} stream its name
   * @param {import('./events.js').StreamEvents} events of the same stream; started and closed by its owner
   */
  constructor(video, stream, events) {
    super();
    this.#stream = stream;
    this.#video = video;
    this.#events = events;
    this.#frames = new VideoFrames(video);
    this.whep = new WhepClient(whepUrl(stream), () => playback(stream));
    this.whep.addEventListener('state', () => {
      this.#playingSince = performance.now();
      this.dispatchEvent(new Event('change'));
    });
    this.whep.addEventListener('stream', ({ detail }) => {
      video.srcObject = detail;
      this.play();
    });
    this.whep.addEventListener('drop', () => video.pause());   // a paused video keeps its last picture
    events.addEventListener('source', () => this.dispatchEvent(new Event('change')));
    // A socket that breaks is the first sign of a dead service; media decides.
    for (const type of ['lost', 'reopened']) events.addEventListener(type, () => this.whep.verify());
  }

  /** Connects now; does nothing while connecting or connected. */
  start() {
    this.whep.start();
  }

  stop() {
    this.whep.close();
  }

  /** Plays on where the browser wanted a gesture first, or stopped in the background. */
  play() {
    if (this.#video.paused && isFed(this.#video)) this.#video.play().catch(() => {});
  }

  /** @returns {ReturnType<typeof describe>} */
  status() {
    const hidden = document.visibilityState === 'hidden';   // no frames are counted then
    if (hidden) this.#playingSince = performance.now();
    const since = Math.max(this.#frames.newestAt, this.#playingSince);
    return describe({
      stream: this.#stream, whep: this.whep, source: this.#events.source, hasPicture: this.#video.videoWidth > 0,
      retryInS: (this.whep.retryAt - performance.now()) / 1000,
      silentMs: this.#frames.count > 0 ? performance.now() - since : 0,
    });
  }
}
