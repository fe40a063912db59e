// The stream's event WebSocket: what the service knows about the source, kept up for as long as the page lives.

import { backoffMs } from './service.js';

/** Events: `source` when `source` changed, `lost` and `reopened` when the socket went down and came back. */
export class StreamEvents extends EventTarget {
  /** Newest known state of the source: {state: live|connecting|lost|idle|failed, detail: string|null}, or null. */
  source = null;

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
    const socket = this.#socket = new WebSocket(this.#url);
    socket.addEventListener('open', () => {
      this.#attempt = 0;
      if (this.#lost) this.dispatchEvent(new Event('reopened'));
      this.#lost = false;
    });
    socket.addEventListener('message', ({ data }) => this.#read(data));
    socket.addEventListener('close', () => {
      if (this.#socket !== socket) return;   // closed by us
      this.#socket = null;
      if (!this.#lost) this.dispatchEvent(new Event('lost'));
      this.#lost = true;
      this.#enter(null);
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

  #read(data) {
    const source = sourceFromMessage(JSON.parse(data));
    if (source) this.#enter(source);
  }

  #enter(source) {
    this.source = source;
    this.dispatchEvent(new Event('source'));
  }
}

/** The source's state in an event message, or null where the message is about something else. */
export function sourceFromMessage(message) {
  if (message.type === 'source') return { state: message.state, detail: message.detail ?? null };
  if (message.type === 'snapshot' && message.stream) {
    return { state: message.stream.state ?? null, detail: message.stream.detail ?? null };
  }
  return null;
}
