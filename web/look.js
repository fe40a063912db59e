// Where the viewer looks without a headset: drag with inertia, wheel, pinch, keyboard, phone orientation.

import { RADIANS, multiply, rotationFromDevice, rotationFromYawPitch, yawOfRotation } from './camera.js';

const FOV_LIMITS = [20 * RADIANS, 110 * RADIANS];
const PITCH_LIMIT = 90 * RADIANS;
const INERTIA_S = 0.25;            // a flick dies down to 1/e in this time
const FASTEST = 6;                // radians per second; two events in one millisecond say nothing about speed
const KEY_STEP = 4 * RADIANS;      // one tap
const KEY_SPEED = 60 * RADIANS;    // per second, held
const KEY_HOLD_S = 0.2;
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const ZOOMS = { '+': 1 / 1.15, '=': 1 / 1.15, '-': 1.15, '_': 1.15 };

const clamp = (value, [low, high]) => Math.min(high, Math.max(low, value));

/** Reads #yaw=90&pitch=0&fov=75 (degrees); what is missing or no number is left out. */
export function lookFromHash(hash) {
  const look = {};
  for (const [key, text] of new URLSearchParams(hash.replace(/^#/, ''))) {
    const degrees = text.trim() === '' ? NaN : Number(text);
    if (['yaw', 'pitch', 'fov'].includes(key) && Number.isFinite(degrees)) look[key] = degrees * RADIANS;
  }
  return look;
}

export class Look {
  /** Radians; yaw 0 is the panorama's forward, positive to the right; pitch positive up; fov is vertical. */
  yaw = 0;
  pitch = 0;
  fov;
  /** Rotation of the phone in the hand while it steers, else null. */
  device = null;

  #element;
  #velocity = [0, 0];
  #pointers = new Map();
  #held = new Map();
  #deviceYaw = 0;
  #onDevice = null;

  /** @param {HTMLElement} element what is dragged; its height is fov high */
  constructor(element) {
    this.#element = element;
    this.fov = (element.clientWidth < element.clientHeight ? 90 : 75) * RADIANS;
    this.set(lookFromHash(location.hash));
    this.#listen();
  }

  /** @param {{yaw?: number, pitch?: number, fov?: number}} look radians; stops all movement */
  set({ yaw = this.yaw, pitch = this.pitch, fov = this.fov }) {
    this.yaw = Math.atan2(Math.sin(yaw), Math.cos(yaw));
    this.pitch = clamp(pitch, [-PITCH_LIMIT, PITCH_LIMIT]);
    this.fov = clamp(fov, FOV_LIMITS);
    this.#velocity = [0, 0];
  }

  get worldFromView() {
    if (!this.device) return rotationFromYawPitch(this.yaw, this.pitch);
    return multiply(rotationFromYawPitch(this.yaw - this.#deviceYaw, 0), this.device);
  }

  /** Moves on by dt seconds; true while something moves. */
  update(dt) {
    let moving = this.#held.size > 0 || this.device !== null;
    for (const [key, heldFor] of this.#held) {
      this.#held.set(key, heldFor + dt);
      if (heldFor > KEY_HOLD_S) this.#turn(...TURNS[key].map((way) => way * KEY_SPEED * dt * this.#zoomScale()));
    }
    if (this.#pointers.size === 0 && Math.hypot(...this.#velocity) > 0.01) {
      this.#turn(this.#velocity[0] * dt, this.#velocity[1] * dt);
      this.#velocity = this.#velocity.map((v) => v * Math.exp(-dt / INERTIA_S));
      moving = true;
    }
    return moving || this.#pointers.size > 0;
  }

  /** Lets the phone's orientation steer. Must run in a click: iOS asks for permission. Throws an Error that says why not. */
  async startDevice() {
    if (typeof DeviceOrientationEvent === 'undefined') throw new Error('This device has no orientation sensor.');
    if (DeviceOrientationEvent.requestPermission) {
      if (await DeviceOrientationEvent.requestPermission() !== 'granted') throw new Error('Motion access was denied.');
    }
    this.#onDevice = (event) => this.#steer(event);
    addEventListener('deviceorientation', this.#onDevice);
  }

  stopDevice() {
    removeEventListener('deviceorientation', this.#onDevice);
    this.#onDevice = null;
    if (!this.device) return;
    const forward = this.worldFromView;
    this.device = null;
    this.set({ yaw: yawOfRotation(forward), pitch: Math.asin(clamp(-forward[7], [-1, 1])) });
  }

  get deviceSteers() {
    return this.#onDevice !== null;
  }

  #steer({ alpha, beta, gamma }) {
    if (alpha === null || beta === null || gamma === null) return;   // a desktop browser's empty event
    const rotation = rotationFromDevice(alpha, beta, gamma, screen.orientation?.angle ?? window.orientation ?? 0);
    if (!this.device) this.#deviceYaw = yawOfRotation(rotation);     // go on from where the viewer looked
    this.device = rotation;
  }

  #turn(yaw, pitch) {
    this.yaw = Math.atan2(Math.sin(this.yaw + yaw), Math.cos(this.yaw + yaw));
    this.pitch = clamp(this.pitch + pitch, [-PITCH_LIMIT, PITCH_LIMIT]);
  }

  #zoom(factor) {
    this.fov = clamp(this.fov * factor, FOV_LIMITS);
  }

  #zoomScale() {
    return this.fov / (75 * RADIANS);
  }

  #listen() {
    const element = this.#element;
    element.addEventListener('pointerdown', (event) => this.#press(event));
    element.addEventListener('pointermove', (event) => this.#drag(event));
    for (const type of ['pointerup', 'pointercancel']) element.addEventListener(type, (event) => this.#release(event));
    element.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.#zoom(Math.exp(clamp(event.deltaY * (event.deltaMode === 1 ? 33 : 1), [-200, 200]) * 0.001));
    }, { passive: false });
    addEventListener('keydown', (event) => this.#keyDown(event));
    addEventListener('keyup', (event) => this.#held.delete(event.key));
    addEventListener('blur', () => this.#held.clear());
    addEventListener('hashchange', () => this.set(lookFromHash(location.hash)));
  }

  #press(event) {
    this.#element.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY, event.timeStamp]);
    this.#velocity = [0, 0];
  }

  #drag(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY, event.timeStamp];
    if (this.#pointers.size === 2) {
      const other = [...this.#pointers].find(([id]) => id !== event.pointerId)[1];
      const distance = (p) => Math.max(1, Math.hypot(p[0] - other[0], p[1] - other[1]));
      this.#zoom(distance(before) / distance(now));
    } else if (this.#pointers.size === 1) {
      // What is under the pointer in the middle of the view stays under it.
      const perPixel = 2 * Math.tan(this.fov / 2) / this.#element.clientHeight;
      const turn = [(before[0] - now[0]) * perPixel, (now[1] - before[1]) * perPixel];
      this.#turn(...turn);
      const dt = Math.max(1, now[2] - before[2]) / 1000;
      this.#velocity = this.#velocity.map((v, i) => clamp(0.5 * v + 0.5 * turn[i] / dt, [-FASTEST, FASTEST]));
    }
    this.#pointers.set(event.pointerId, now);
  }

  #release(event) {
    const last = this.#pointers.get(event.pointerId);
    if (!last) return;
    this.#pointers.delete(event.pointerId);
    const held = event.timeStamp - last[2] > 80;   // let go at rest, not flicked
    const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
    if (held || calm || this.#pointers.size > 0) this.#velocity = [0, 0];
  }

  #keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.('input, select, textarea')) return;
    if (TURNS[event.key]) {
      event.preventDefault();
      if (!event.repeat) {
        this.#held.set(event.key, 0);
        this.#turn(...TURNS[event.key].map((way) => way * KEY_STEP * this.#zoomScale()));
      }
    } else if (ZOOMS[event.key]) {
      this.#zoom(ZOOMS[event.key]);
    }
  }
}
