// The detected lights as rows of words, at most five times a second.

import { hexFromLinear } from './color.js';
import { LiveSocket } from './live_socket.js';

const INTERVAL_MS = 200;
const MAX_LIGHTS = 8;

export class LightList {
  #rows;
  #note;
  #socket;
  #newest = null;
  #timer = null;

  /**
   * @param {HTMLTableSectionElement} rows
   * @param {HTMLElement} note for what is not in the rows
   * @param {string} url of the stream's lights WebSocket
   */
  constructor(rows, note, url) {
    this.#rows = rows;
    this.#note = note;
    this.#socket = new LiveSocket(url);
    this.#socket.addEventListener('text', ({ detail }) => {
      this.#newest = detail;
      this.#timer ??= setTimeout(() => this.#show(), INTERVAL_MS);
    });
    this.#socket.addEventListener('lost', () => { note.textContent = 'No connection to the service. Reconnecting…'; });
    this.#socket.addEventListener('reopened', () => { note.textContent = 'Waiting for a picture…'; });
  }

  start() {
    this.#socket.start();
  }

  stop() {
    this.#socket.close();
    clearTimeout(this.#timer);
    this.#timer = null;
  }

  #show() {
    this.#timer = null;
    const { lights, ambient } = JSON.parse(this.#newest);
    const strongest = [...lights].sort((a, b) => brightness(b.irradiance) - brightness(a.irradiance));
    const shown = strongest.slice(0, MAX_LIGHTS).map((light) => [where(light.direction), light.irradiance, size(light)]);
    this.#rows.replaceChildren(...[...shown, ['everywhere else', ambient, '']].map(row));
    const rest = lights.length - MAX_LIGHTS;
    this.#note.textContent = rest > 0 ? `${rest} weaker ones are not listed.` : '';
  }
}

/** @param {number[]} direction towards the light */
export function where([x, y, z]) {
  const degrees = (radians) => Math.round(radians * 180 / Math.PI);
  const [yaw, pitch] = [degrees(Math.atan2(x, -z)), degrees(Math.atan2(y, Math.hypot(x, z)))];
  const side = yaw === 0 ? 'ahead' : `${Math.abs(yaw)}° ${yaw > 0 ? 'right' : 'left'}`;
  return `${side}, ${Math.abs(pitch)}° ${pitch < 0 ? 'down' : 'up'}`;
}

const size = (light) => `${(2 * light.angular_radius * 180 / Math.PI).toFixed(1)}°`;

const brightness = ([red, green, blue]) => 0.2126 * red + 0.7152 * green + 0.0722 * blue;

function row([place, color, width]) {
  const swatch = document.createElement('span');
  swatch.className = 'swatch';
  const brightest = Math.max(...color, 1e-9);
  swatch.style.backgroundColor = hexFromLinear(color.map((value) => value / brightest));
  const node = document.createElement('tr');
  node.append(cell('th', place), cell('td', swatch, color.map((value) => value.toFixed(2)).join(' ')), cell('td', width));
  return node;
}

function cell(name, ...content) {
  const node = document.createElement(name);
  if (name === 'th') node.scope = 'row';
  node.append(...content);
  return node;
}
