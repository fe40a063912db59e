// Sends changed values: often enough to look live, never faster than they are answered, the last one always.

import { backoffMs } from './service.js';

const PER_SECOND = 15;

export class ChangeSender {
  #send;
  #intervalMs;
  #waiting = new Map();
  #sentAt = -Infinity;
  #attempt = 0;
  #busy = false;
  #closed = false;
  #timer = null;

  /**
   * @param {(changes: Map<string, unknown>) => Promise<void>} send JSON pointer → value; throws ServiceError
   * @param {object} told what became of them; each is called with the changes it is about
   * @param {(changes: Map) => void} told.accepted
   * @param {(changes: Map, error: Error) => void} told.refused the service says they are wrong; they are not sent again
   * @param {(changes: Map, error: Error) => void} told.delayed the service cannot be reached; they are sent again
   */
  constructor(send, told, intervalMs = 1000 / PER_SECOND) {
    this.#send = send;
    this.told = told;
    this.#intervalMs = intervalMs;
  }

  /** A newer value takes the place of one that is still waiting. */
  put(pointer, value) {
    this.#waiting.delete(pointer);   // so that it also takes its place in the order
    this.#waiting.set(pointer, value);
    this.#schedule();
  }

  /** Takes back a value that is still waiting. */
  forget(pointer) {
    this.#waiting.delete(pointer);
  }

  close() {
    this.#closed = true;
    clearTimeout(this.#timer);
  }

  #schedule() {
    if (this.#closed || this.#busy || this.#timer !== null || this.#waiting.size === 0) return;
    const pause = this.#attempt > 0 ? backoffMs(this.#attempt) : this.#sentAt + this.#intervalMs - performance.now();
    this.#timer = setTimeout(() => this.#run(), Math.max(0, pause));
  }

  async #run() {
    this.#timer = null;
    if (this.#waiting.size === 0) return;
    const changes = this.#waiting;
    this.#waiting = new Map();
    this.#sentAt = performance.now();
    this.#busy = true;
    try {
      await this.#send(changes);
      this.#attempt = 0;
      this.told.accepted(changes);
    } catch (error) {
      this.#fail(changes, error);
    }
    this.#busy = false;
    this.#schedule();
  }

  #fail(changes, error) {
    this.#attempt = error.unreachable ? this.#attempt + 1 : 0;
    const wrong = new Map([...changes].filter(([pointer]) => error.concerns?.(pointer)));
    if (error.unreachable) {
      this.#putBack(changes);
      this.told.delayed(changes, error);
    } else if (wrong.size > 0) {
      this.#putBack(new Map([...changes].filter(([pointer]) => !wrong.has(pointer))));   // refused along with it
      this.told.refused(wrong, error);
    } else {
      this.told.refused(changes, error);
    }
  }

  #putBack(changes) {
    this.#waiting = new Map([...changes, ...this.#waiting]);
  }
}
