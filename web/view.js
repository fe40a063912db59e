// The viewer page: connects, draws, and says in words what is going on.

import { perspective, worldFromScreen } from './camera.js';
import { StreamEvents } from './events.js';
import { Look } from './look.js';
import { Panorama } from './panorama.js';
import { eventsUrl, playback, whepUrl } from './service.js';
import { Statistics } from './statistics.js';
import { describe } from './status.js';
import { VideoFrames, isFed } from './video_frames.js';
import { WhepClient } from './whep.js';
import { ImmersiveView, whyNoVr } from './xr.js';

const MAX_PIXEL_RATIO = 2;
const STATUS_MS = 250;

const element = (id) => document.getElementById(id);

class Viewer {
  stream = decodeURIComponent(location.pathname.replace(/\/+$/, '').split('/').pop());
  canvas = element('panorama');
  video = element('video');

  constructor(gl) {
    this.panorama = new Panorama(gl);
    this.frames = new VideoFrames(this.video);
    this.look = new Look(this.canvas);
    this.whep = new WhepClient(whepUrl(this.stream), () => playback(this.stream));
    this.events = new StreamEvents(eventsUrl(this.stream));
    this.immersive = new ImmersiveView(this.panorama, this.video, this.frames);
    this.statistics = null;
    this.playingSince = null;
    this.drawnAt = 0;
    this.stale = true;
    this.#connectParts();
    this.#connectButtons();
    this.#connectPage();
  }

  start() {
    this.whep.start();
    this.events.start();
    this.statusTimer = setInterval(() => this.showStatus(), STATUS_MS);
    this.#loop(performance.now());
  }

  stop() {
    cancelAnimationFrame(this.loop);
    clearInterval(this.statusTimer);
    this.whep.close();
    this.events.close();
  }

  /** Draws the view now, whether or not anything changed. */
  render() {
    const { width, height } = this.canvas;
    const projection = perspective(this.look.fov, width / height);
    this.panorama.gl.clear(this.panorama.gl.COLOR_BUFFER_BIT);
    this.panorama.draw(worldFromScreen(projection, this.look.worldFromView), { x: 0, y: 0, width, height });
    this.stale = false;
  }

  showStatus() {
    const { whep, events, frames } = this;
    const hasPicture = this.panorama.size[0] > 0 || this.video.videoWidth > 0;
    const since = Math.max(frames.newestAt, this.playingSince ?? 0);
    const status = describe({
      stream: this.stream, whep, source: events.source, hasPicture,
      retryInS: (whep.retryAt - performance.now()) / 1000,
      // In an immersive session some browsers count no frames: silence means nothing there.
      silentMs: frames.count > 0 && !this.immersive.session ? performance.now() - since : 0,
    });
    document.body.dataset.level = status.level;
    document.body.dataset.picture = hasPicture;
    setText('status-title', status.title);
    setText('status-detail', status.detail);
    element('retry').hidden = !status.canRetry;
    this.immersive.notify(status.level === 'ok' ? null : status);
    this.#showVrButton(hasPicture);
  }

  #loop(now) {
    this.loop = requestAnimationFrame((next) => this.#loop(next));
    if (this.immersive.session) return;   // the headset's own frame loop draws
    const moved = this.look.update(Math.min(0.1, (now - this.drawnAt) / 1000));
    this.drawnAt = now;
    const fresh = this.frames.take();
    if (fresh) this.panorama.upload(this.video);
    if (fresh || moved || this.stale) this.render();
  }

  #connectParts() {
    this.whep.addEventListener('state', () => {
      this.playingSince = this.whep.state === 'connected' ? performance.now() : null;
      this.showStatus();
    });
    this.whep.addEventListener('stream', ({ detail }) => {
      this.video.srcObject = detail;
      const offerSound = () => { element('sound').hidden = detail.getAudioTracks().length === 0; };
      detail.addEventListener('addtrack', offerSound);
      offerSound();
      this.video.play().catch(() => {});   // a later gesture starts it
    });
    this.whep.addEventListener('drop', () => this.video.pause());   // a paused video keeps its last picture
    this.events.addEventListener('source', () => this.showStatus());
    // A socket that breaks is the first sign of a dead service; media decides.
    for (const type of ['lost', 'reopened']) this.events.addEventListener(type, () => this.whep.verify());
    this.immersive.addEventListener('start', () => this.#showVrState(true));
    this.immersive.addEventListener('end', () => this.#showVrState(false));
  }

  #connectButtons() {
    element('retry').addEventListener('click', () => this.whep.start());
    element('sound').addEventListener('click', () => this.#toggleSound());
    element('statistics-button').addEventListener('click', () => this.#toggleStatistics());
    element('fullscreen').hidden = !document.fullscreenEnabled;
    element('fullscreen').addEventListener('click', () => this.#toggleFullscreen());
    element('vr').addEventListener('click', () => this.#toggleVr());
    element('motion').hidden = typeof DeviceOrientationEvent === 'undefined' || !matchMedia('(pointer: coarse)').matches;
    element('motion').addEventListener('click', () => this.#toggleMotion());
    const ask = async () => {
      this.vrObstacle = await whyNoVr();
      this.showStatus();
    };
    this.vrObstacle = 'Looking for a headset…';
    navigator.xr?.addEventListener?.('devicechange', ask);
    ask();
  }

  #connectPage() {
    new ResizeObserver(() => this.#resize()).observe(this.canvas);
    this.#resize();
    for (const type of ['pointermove', 'wheel']) this.canvas.addEventListener(type, () => { this.stale = true; });
    for (const type of ['keydown', 'hashchange', 'deviceorientation']) addEventListener(type, () => { this.stale = true; });
    this.canvas.addEventListener('webglcontextrestored', () => { this.stale = true; });
    addEventListener('keydown', (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
      if (event.key === 'i') this.#toggleStatistics();
      if (event.key === 'f') this.#toggleFullscreen();
      if (event.key === 'm') this.#toggleSound();
    });
    document.addEventListener('visibilitychange', () => { this.playingSince = performance.now(); });
    addEventListener('online', () => this.whep.start());
    addEventListener('pointerdown', () => this.video.paused && isFed(this.video) && this.video.play().catch(() => {}));
    addEventListener('pagehide', () => this.stop());
    addEventListener('pageshow', ({ persisted }) => persisted && this.start());
  }

  #resize() {
    if (this.immersive.session) return;
    const ratio = Math.min(MAX_PIXEL_RATIO, devicePixelRatio);
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    this.render();   // at once: resizing has cleared the canvas
  }

  #toggleFullscreen() {
    const change = document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen();
    change.catch((error) => setText('note', `Full screen was refused: ${error.message}`));
  }

  /** Off until a person asks: browsers play nothing aloud before that. */
  #toggleSound() {
    this.video.muted = !this.video.muted;
    element('sound').setAttribute('aria-pressed', !this.video.muted);
    this.video.play().catch(() => {});
  }

  async #toggleVr() {
    setText('note', '');
    try {
      await (this.immersive.session ? this.immersive.exit() : this.immersive.enter());
    } catch (error) {
      setText('note', error.message);
    }
  }

  #showVrButton(hasPicture) {
    const obstacle = this.vrObstacle ?? (hasPicture ? null : 'VR starts with the first picture.');
    element('vr').disabled = obstacle !== null && !this.immersive.session;
    setText('vr-note', obstacle ?? '');
  }

  #showVrState(presenting) {
    setText('vr', presenting ? 'Leave VR' : 'Enter VR');
    this.playingSince = performance.now();
    if (!presenting) this.#resize();
  }

  async #toggleMotion() {
    try {
      if (this.look.deviceSteers) this.look.stopDevice();
      else await this.look.startDevice();
    } catch (error) {
      setText('note', error.message);
    }
    element('motion').setAttribute('aria-pressed', this.look.deviceSteers);
    this.stale = true;
  }

  #toggleStatistics() {
    const show = element('statistics').hidden;
    element('statistics').hidden = !show;
    element('statistics-button').setAttribute('aria-expanded', show);
    clearInterval(this.statisticsTimer);
    this.statistics?.close();
    this.statistics = show ? new Statistics(this.video, this.frames) : null;
    if (!show) return;
    this.statisticsTimer = setInterval(() => this.#showStatistics(), 1000);
    this.#showStatistics();
  }

  async #showStatistics() {
    const rows = await this.statistics.read(this.whep.peer);
    element('statistics').replaceChildren(...rows.map(([label, value]) => {
      const row = document.createElement('div');
      row.append(tag('dt', label), tag('dd', value));
      return row;
    }));
  }
}

function tag(name, text) {
  const node = document.createElement(name);
  node.textContent = text;
  return node;
}

/** Leaves an unchanged text alone, so that a screen reader does not read it again. */
function setText(id, text) {
  const node = element(id);
  if (node.textContent !== text) node.textContent = text;
  if (id === 'note' || id === 'vr-note') node.hidden = text === '';
}

const gl = element('panorama').getContext('webgl2', { alpha: false, antialias: false, depth: false });
if (gl) {
  const viewer = new Viewer(gl);
  window.mr360 = { viewer };   // for the tests and the curious
  document.title = `${viewer.stream} · mr360`;
  setText('stream-name', viewer.stream);
  viewer.start();
} else {
  document.body.dataset.level = 'error';
  setText('status-title', 'No WebGL 2 in this browser');
  setText('status-detail', 'Drawing the panorama needs it. Turn on hardware acceleration or try another browser.');
}
