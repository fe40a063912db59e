// A WebSocket of the service that is made again for as long as the page wants it.

import { backoffMs, socketProtocols } from './service.js';

/** Events: `text` with `detail` = one message's text, `lost` and `reopened` when the socket went down and came back. */
export class LiveSocket extends EventTarget {
  #url;
  #socket = null;
  #attempt = 0;
  #timer = null;
  #lost = false;

  /** @param {string} url ws: or wss: */
  constructor(url) {
    super();
    this.#url = url;
  }

  start() {
    if (this.#socket) return;
    clearTimeout(this.#timer);
    const socket = this.#socket = new WebSocket(this.#url, socketProtocols());
    socket.addEventListener('open', () => {
      this.#attempt = 0;
      if (this.#lost) this.dispatchEvent(new Event('reopened'));
      this.#lost = false;
    });
    socket.addEventListener('message', ({ data }) => {
      if (this.#socket === socket) this.dispatchEvent(new CustomEvent('text', { detail: data }));
    });
    socket.addEventListener('close', () => {
      if (this.#socket !== socket) return;   // closed by us
      this.#socket = null;
      if (!this.#lost) this.dispatchEvent(new Event('lost'));
      this.#lost = true;
      this.#attempt += 1;
      this.#timer = setTimeout(() => this.start(), backoffMs(this.#attempt));
    });
  }

  close() {
    clearTimeout(this.#timer);
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
  }
}
