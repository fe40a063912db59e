// Immersive sessions: the panorama in a headset, as a media layer where there is one, else drawn per eye.

import { multiply, rotationFromTransform, worldFromScreen } from './camera.js';
import { Notice, PANEL } from './notice.js';
import { isFed } from './video_frames.js';

const REFUSALS = {
  NotAllowedError: 'VR was not allowed. Allow it in the browser’s site settings and press “Enter VR” again.',
  SecurityError: 'VR was not allowed. Allow it in the browser’s site settings and press “Enter VR” again.',
  NotSupportedError: 'The headset does not offer immersive VR now.',
  InvalidStateError: 'Another page or tab is using the headset.',
};

/** @returns {Promise<?string>} null if immersive VR can be entered, else a sentence why it cannot */
export async function whyNoVr() {
  if (!window.isSecureContext) return 'VR needs https (or localhost).';
  if (!navigator.xr) return 'This browser has no WebXR.';
  const supported = await navigator.xr.isSessionSupported('immersive-vr').catch(() => false);
  return supported ? null : 'No VR headset found.';
}

/**
 * Events: `start`, `end`.
 *
 * The viewer's position is ignored, since a panorama is infinitely far away. The session's `local` space is the world:
 * when the wearer recentres, its origin moves and with it the panorama's forward.
 */
export class ImmersiveView extends EventTarget {
  /** @type {?XRSession} */
  session = null;
  /** How the panorama is shown: `layer` (media layer), `draw` (ray-cast per eye), or null without a session. */
  path = null;

  #panorama;
  #video;
  #frames;
  #space = null;
  #headSpace = null;
  #layer = null;
  #notice;
  #noticeLayer = null;
  #paintedVersion = -1;
  #starting = false;

  /**
   * @param {import('./panorama.js').Panorama} panorama
   * @param {HTMLVideoElement} video
   * @param {import('./video_frames.js').VideoFrames} frames
   */
  constructor(panorama, video, frames) {
    super();
    this.#panorama = panorama;
    this.#video = video;
    this.#frames = frames;
    this.#notice = new Notice(panorama.gl);
    // A new connection or another geometry: a layer made for the old one may stay black.
    for (const type of ['loadeddata', 'resize']) video.addEventListener(type, () => this.#renewLayer());
  }

  /** Must be called in a click. Throws an Error with a sentence for the wearer. */
  async enter() {
    if (this.session || this.#starting) return;
    this.#starting = true;
    this.#keepPlaying();   // inside the gesture: Vision Pro pauses the video on entering
    try {
      const session = await navigator.xr.requestSession('immersive-vr', { optionalFeatures: ['layers'] });
      await this.#begin(session).catch(async (error) => {
        await session.end().catch(() => {});
        throw error;
      });
    } catch (error) {
      throw new Error(REFUSALS[error.name] ?? `VR could not start: ${error.message}`);
    } finally {
      this.#starting = false;
    }
  }

  async exit() {
    await this.session?.end();
  }

  /** @param {?{level: string, title: string, detail: string}} status what the wearer must know now, or null */
  notify(status) {
    const wasVisible = this.#notice.visible;
    this.#notice.show(status);
    if (this.path === 'layer' && this.#notice.visible !== wasVisible) this.#stackLayers();
  }

  async #begin(session) {
    this.session = session;
    session.addEventListener('end', () => this.#ended(), { once: true });
    session.addEventListener('visibilitychange', () => this.#keepPlaying());
    session.addEventListener('select', () => this.#keepPlaying());
    await this.#panorama.gl.makeXRCompatible();
    this.#space = await session.requestReferenceSpace('local');
    this.#headSpace = await session.requestReferenceSpace('viewer');
    if (!this.#showLayer()) this.#showDrawing();
    session.requestAnimationFrame((time, frame) => this.#onFrame(frame));
    this.#keepPlaying();
    this.dispatchEvent(new Event('start'));
  }

  /** The compositor samples the video itself: sharper and cheaper than anything a page can draw. */
  #showLayer() {
    const { session } = this;
    if (session.enabledFeatures && !session.enabledFeatures.includes('layers')) return false;
    if (typeof XRMediaBinding === 'undefined') return false;
    try {
      const layer = new XRMediaBinding(session).createEquirectLayer(this.#video, {
        space: this.#space,
        layout: 'mono',
        radius: 0,   // infinitely far
        centralHorizontalAngle: 2 * Math.PI,
        upperVerticalAngle: Math.PI / 2,
        lowerVerticalAngle: -Math.PI / 2,
      });
      const old = this.#layer;
      this.#layer = layer;
      this.#stackLayers();
      old?.destroy?.();
      this.path = 'layer';
      return true;
    } catch (error) {
      this.#layer = null;
      console.warn(`no media layer, drawing instead: ${error.message}`);
      return false;
    }
  }

  #stackLayers() {
    const notice = this.#notice.visible ? this.#noticeLayer ??= this.#createNoticeLayer() : null;
    this.session.updateRenderState({ layers: notice ? [this.#layer, notice] : [this.#layer] });
  }

  /** A panel that moves with the head, or null where layers cannot carry one. */
  #createNoticeLayer() {
    try {
      const { x, y, z, width, height } = PANEL;
      const { canvas } = this.#notice;
      const binding = new XRWebGLBinding(this.session, this.#panorama.gl);
      const layer = binding.createQuadLayer({
        space: this.#headSpace, layout: 'mono', viewPixelWidth: canvas.width, viewPixelHeight: canvas.height,
        transform: new XRRigidTransform({ x, y, z }),
        width: width / 2, height: height / 2,   // browsers take half the size, whatever the specification says
      });
      this.#paintedVersion = -1;
      return Object.assign(layer, { binding });
    } catch (error) {
      console.warn(`no notices in the headset: ${error.message}`);
      return null;
    }
  }

  #paintNoticeLayer(frame) {
    const { gl } = this.#panorama;
    const layer = this.#noticeLayer;
    if (!layer || !this.#notice.visible) return;
    if (this.#paintedVersion === this.#notice.version && !layer.needsRedraw) return;
    gl.bindTexture(gl.TEXTURE_2D, layer.binding.getSubImage(layer, frame).colorTexture);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, this.#notice.canvas);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    this.#paintedVersion = this.#notice.version;
  }

  #showDrawing() {
    // No geometry: neither depth nor antialiasing. The default buffer out-resolves a 4K panorama on today's headsets.
    const options = { alpha: false, depth: false, stencil: false, antialias: false };
    this.session.updateRenderState({ baseLayer: new XRWebGLLayer(this.session, this.#panorama.gl, options) });
    this.path = 'draw';
  }

  #renewLayer() {
    if (this.path === 'layer' && !this.#showLayer()) this.#showDrawing();
  }

  #onFrame(frame) {
    const { session } = this;
    if (!session) return;
    session.requestAnimationFrame((time, next) => this.#onFrame(next));
    if (this.path === 'layer') this.#paintNoticeLayer(frame);
    const target = session.renderState.baseLayer;
    if (this.path !== 'draw' || !target) return;
    const pose = frame.getViewerPose(this.#space);
    if (!pose) return;   // tracking is lost
    if (this.#frames.take()) this.#panorama.upload(this.#video);
    const { gl } = this.#panorama;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const view of pose.views) {
      const viewport = target.getViewport(view);
      if (!viewport || viewport.width === 0) continue;
      const rotation = rotationFromTransform(view.transform.matrix);
      this.#panorama.draw(worldFromScreen(view.projectionMatrix, rotation), viewport);
      const eyeFromHead = multiply(view.transform.inverse.matrix, pose.transform.matrix);
      this.#notice.draw(multiply(view.projectionMatrix, eyeFromHead));
    }
  }

  #ended() {
    const { gl } = this.#panorama;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    Object.assign(this, { session: null, path: null });
    this.#space = this.#headSpace = null;
    this.#layer = this.#noticeLayer = null;
    this.#keepPlaying();
    this.dispatchEvent(new Event('end'));
  }

  #keepPlaying() {
    if (isFed(this.#video)) this.#video.play().catch(() => {});   // refused outside a gesture: the next one works
  }
}
