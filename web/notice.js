// A notice in the headset, where the page's own words cannot be seen: a small panel below the middle of the view.

import { link } from './program.js';

const WIDTH_PX = 1024;
const HEIGHT_PX = 256;
const COLORS = { ok: '#5ad17f', busy: '#7cc4ff', warning: '#ffc75a', error: '#ff7a70' };

/** Where the panel hangs in the head's space, metres. */
export const PANEL = { x: 0, y: -0.45, z: -2, width: 1.4, height: 0.35 };

const VERTEX_SHADER = `#version 300 es
uniform mat4 clip_from_head;
uniform vec3 middle;
uniform vec2 half_size;
out vec2 uv;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  uv = vec2(corner.x, 1.0 - corner.y);   // the texture's row 0 is up
  gl_Position = clip_from_head * vec4(middle + vec3((corner * 2.0 - 1.0) * half_size, 0.0), 1.0);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision mediump float;
uniform sampler2D text;
in vec2 uv;
out vec4 color;
void main() {
  color = texture(text, uv);
}`;

export class Notice {
  /** Counts changes of what is shown. */
  version = 0;
  /** The panel as a picture, display-coded and premultiplied; row 0 is up. */
  canvas;

  #gl;
  #shown = '';
  #program = null;
  #texture = null;
  #uploaded = -1;

  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.#gl = gl;
    this.canvas = document.createElement('canvas');
    Object.assign(this.canvas, { width: WIDTH_PX, height: HEIGHT_PX });
    gl.canvas.addEventListener('webglcontextrestored', () => { this.#program = null; });
  }

  get visible() {
    return this.#shown !== '';
  }

  /** @param {?{level: string, title: string, detail: string}} status what to say, or null for nothing */
  show(status) {
    const shown = status ? JSON.stringify([status.level, status.title, status.detail]) : '';
    if (shown === this.#shown) return;
    this.#shown = shown;
    this.version += 1;
    if (status) this.#paint(status);
  }

  /** Draws into the bound framebuffer and its viewport. @param {number[]} clipFromHead 4×4 */
  draw(clipFromHead) {
    if (!this.visible) return;
    const gl = this.#gl;
    if (!this.#program) this.#create();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.#texture);
    if (this.#uploaded !== this.version) this.#upload();
    gl.useProgram(this.#program);
    const uniform = (name) => gl.getUniformLocation(this.#program, name);
    gl.uniformMatrix4fv(uniform('clip_from_head'), false, new Float32Array(clipFromHead));
    gl.uniform3f(uniform('middle'), PANEL.x, PANEL.y, PANEL.z);
    gl.uniform2f(uniform('half_size'), PANEL.width / 2, PANEL.height / 2);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.disable(gl.BLEND);
  }

  #create() {
    const gl = this.#gl;
    this.#program = link(gl, VERTEX_SHADER, FRAGMENT_SHADER);
    this.#texture = gl.createTexture();
    this.#uploaded = -1;
    gl.bindTexture(gl.TEXTURE_2D, this.#texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  #upload() {
    const gl = this.#gl;
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, this.canvas);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    this.#uploaded = this.version;
  }

  #paint({ level, title, detail }) {
    const context = this.canvas.getContext('2d');
    context.clearRect(0, 0, WIDTH_PX, HEIGHT_PX);
    context.fillStyle = 'rgb(13 17 23 / 88%)';
    context.beginPath();
    context.roundRect(4, 4, WIDTH_PX - 8, HEIGHT_PX - 8, 32);
    context.fill();
    context.lineWidth = 6;
    context.strokeStyle = COLORS[level] ?? COLORS.busy;
    context.stroke();
    context.textAlign = 'center';
    context.fillStyle = '#f0f4f8';
    context.font = '600 56px system-ui, sans-serif';
    const rows = lines(context, detail, 32, WIDTH_PX - 80);
    context.fillText(title, WIDTH_PX / 2, rows.length ? 96 : 148, WIDTH_PX - 80);
    context.font = '32px system-ui, sans-serif';
    context.fillStyle = '#b4c0cc';
    rows.slice(0, 2).forEach((row, i) => context.fillText(row, WIDTH_PX / 2, 158 + 44 * i, WIDTH_PX - 80));
  }
}

/** Breaks a text into lines of at most `width` pixels. */
function lines(context, text, size, width) {
  context.save();
  context.font = `${size}px system-ui, sans-serif`;
  const rows = [];
  for (const word of text.split(' ').filter(Boolean)) {
    const longer = rows.length ? `${rows.at(-1)} ${word}` : word;
    if (rows.length && context.measureText(longer).width <= width) rows[rows.length - 1] = longer;
    else rows.push(word);
  }
  context.restore();
  return rows;
}
