// Tells when a video element shows a new frame, in a page and in an immersive session.

const SILENCE_MS = 250;

/** False once the stream that feeds the video has ended: the browser then shows a black frame that nobody sent. */
export function isFed(video) {
  return Boolean(video.srcObject?.active);
}

/**
 * requestVideoFrameCallback counts real frames, but some headset browsers do not call it while a session is immersive;
 * when it falls silent, a moving currentTime stands in for it.
 */
export class VideoFrames {
  #video;
  #count = 0;
  #countedAt = -Infinity;
  #seenCount = 0;
  #seenTime = -1;
  #watchers = new Set();

  /** @param {HTMLVideoElement} video */
  constructor(video) {
    this.#video = video;
    if (!video.requestVideoFrameCallback) return;
    const count = (now, metadata) => {
      this.#count += 1;
      this.#countedAt = performance.now();
      for (const watcher of this.#watchers) watcher(now, metadata);
      video.requestVideoFrameCallback(count);
    };
    video.requestVideoFrameCallback(count);
  }

  /** Frames counted so far; stays 0 where the browser cannot count. */
  get count() {
    return this.#count;
  }

  /** performance.now() of the newest frame that was counted or taken. */
  get newestAt() {
    return this.#countedAt;
  }

  /** Calls watcher(now, VideoFrameCallbackMetadata) for every counted frame; returns what stops that. */
  watch(watcher) {
    this.#watchers.add(watcher);
    return () => this.#watchers.delete(watcher);
  }

  /** True once for every frame worth uploading. */
  take() {
    const video = this.#video;
    if (!isFed(video) || video.readyState < HTMLMediaElement.HAVE_CURRENT_DATA || video.videoWidth === 0) return false;
    if (this.#count !== this.#seenCount) {
      this.#seenCount = this.#count;
      this.#seenTime = video.currentTime;
      return true;
    }
    if (performance.now() - this.#countedAt < SILENCE_MS || video.currentTime === this.#seenTime) return false;
    this.#seenTime = video.currentTime;
    return true;
  }
}
