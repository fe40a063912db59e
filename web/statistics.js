// Numbers about what arrives, read on demand from WebRTC's statistics and the video element's frame callbacks.

/**
 * Measures between two calls of read(), so call it about once a second.
 */
export class Statistics {
  #video;
  #last = null;
  #delays = [];
  #stopWatching;

  /**
   * @param {HTMLVideoElement} video
   * @param {import('./video_frames.js').VideoFrames} frames
   */
  constructor(video, frames) {
    this.#video = video;
    this.#stopWatching = frames.watch((now, { receiveTime, presentationTime }) => {
      if (receiveTime !== undefined) this.#delays.push(presentationTime - receiveTime);
      if (this.#delays.length > 240) this.#delays.shift();
    });
  }

  close() {
    this.#stopWatching();
  }

  /** @returns {Promise<Array<[string, string]>>} label and value, ready to show; an unknown value is “–” */
  async read(peer) {
    const reports = [...(await peer?.getStats() ?? new Map()).values()];
    const video = reports.find((report) => report.type === 'inbound-rtp' && report.kind === 'video');
    const path = reports.find((report) => report.type === 'candidate-pair' && report.nominated);
    const last = video?.id === this.#last?.id ? this.#last : null;
    const since = (name) => (video && last ? video[name] - last[name] : NaN);
    const seconds = since('timestamp') / 1000;
    const delays = this.#delays.splice(0).sort((a, b) => a - b);
    this.#last = video;
    return [
      ['Picture', video ? `${this.#video.videoWidth} × ${this.#video.videoHeight}` : '–'],
      ['Rate', `${number(since('framesDecoded') / seconds, 1)} fps`],
      ['Bitrate', `${number(since('bytesReceived') * 8e-6 / seconds, 2)} Mbit/s`],
      ['Network jitter', `${number(video?.jitter * 1000, 1)} ms`],
      ['Round trip', `${number(path?.currentRoundTripTime * 1000, 0)} ms`],
      ['Jitter buffer', `${number(1000 * since('jitterBufferDelay') / since('jitterBufferEmittedCount'), 0)} ms`],
      ['Decoding', `${number(1000 * since('totalDecodeTime') / since('framesDecoded'), 1)} ms`],
      ['Received to shown', `${number(delays[delays.length >> 1], 0)} ms`],
      ['Packets lost', number(video?.packetsLost, 0)],
      ['Frames dropped', number(video?.framesDropped, 0)],
      ['Freezes', number(video?.freezeCount, 0)],
      ['Decoder', video?.decoderImplementation ?? '–'],
    ];
  }
}

function number(value, digits) {
  return Number.isFinite(value) ? value.toFixed(digits) : '–';
}
