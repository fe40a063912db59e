// The stream's event WebSocket: what the service knows about the source and the scene, kept up while the page lives.

import { LiveSocket } from './live_socket.js';

/**
 * Events: `source` when `source` changed, `message` with `detail` = every message as it came, `lost` and `reopened` when
 * the socket went down and came back. Each connection begins with messages of the whole present state.
 */
export class StreamEvents extends LiveSocket {
  /** Newest known state of the source: {state: live|connecting|lost|idle|failed, detail: string|null}, or null. */
  source = null;

  /** @param {string} url ws: or wss: */
  constructor(url) {
    super(url);
    this.addEventListener('text', ({ detail }) => this.#read(JSON.parse(detail)));
    this.addEventListener('lost', () => this.#enter(null));
  }

  #read(message) {
    const source = sourceFromMessage(message);
    if (source) this.#enter(source);
    this.dispatchEvent(new CustomEvent('message', { detail: message }));
  }

  #enter(source) {
    this.source = source;
    this.dispatchEvent(new Event('source'));
  }
}

/** The source's state in an event message, or null where the message is about something else. */
export function sourceFromMessage(message) {
  return message.type === 'source' ? { state: message.state, detail: message.detail ?? null } : null;
}
