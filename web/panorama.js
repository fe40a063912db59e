// Draws an equirectangular texture by casting one ray per pixel: no sphere mesh, hence no facets and no pinched poles.
//
// The texture holds display-coded video and goes to the screen as it is; nothing here decodes or encodes a transfer curve.
// No mipmaps: u jumps from 1 to 0 behind the viewer, and a level chosen from that jump would draw a seam.

import { GLSL_UV_FROM_DIRECTION } from './equirectangular.js';
import { link } from './program.js';

const VERTEX_SHADER = `#version 300 es
uniform mat3 world_from_screen;
out vec3 ray;
void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  ray = world_from_screen * vec3(corner, 1.0);   // linear on the screen, so interpolation is exact
  gl_Position = vec4(corner, 0.0, 1.0);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;   // mediump would jitter by whole pixels of the panorama
uniform sampler2D panorama;
in vec3 ray;
out vec4 color;
${GLSL_UV_FROM_DIRECTION}
void main() {
  color = vec4(texture(panorama, uvFromDirection(ray)).rgb, 1.0);
}`;

export class Panorama {
  #gl;
  #program = null;
  #rayUniform = null;
  #texture = null;

  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.#gl = gl;
    this.#create();
    gl.canvas.addEventListener('webglcontextlost', (event) => event.preventDefault());
    gl.canvas.addEventListener('webglcontextrestored', () => this.#create());
  }

  get gl() {
    return this.#gl;
  }

  /** Size of the picture that is drawn, [0, 0] before the first one. */
  size = [0, 0];

  #create() {
    const gl = this.#gl;
    this.#program = link(gl, VERTEX_SHADER, FRAGMENT_SHADER);
    this.#rayUniform = gl.getUniformLocation(this.#program, 'world_from_screen');
    this.#texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.#texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    this.size = [0, 0];
  }

  /** @param {TexImageSource} picture a playing video, a canvas or a bitmap; row 0 is up */
  upload(picture) {
    const gl = this.#gl;
    gl.bindTexture(gl.TEXTURE_2D, this.#texture);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    this.size = [picture.videoWidth ?? picture.width, picture.videoHeight ?? picture.height];
  }

  /**
   * Draws one view into the bound framebuffer.
   *
   * @param {Float32Array} worldFromScreen 3×3, see camera.js
   * @param {{x: number, y: number, width: number, height: number}} viewport pixels
   */
  draw(worldFromScreen, { x, y, width, height }) {
    const gl = this.#gl;
    gl.viewport(x, y, width, height);
    if (this.size[0] === 0) return;   // nothing has arrived yet: the cleared background stays
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.disable(gl.CULL_FACE);
    gl.useProgram(this.#program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.#texture);
    gl.uniformMatrix3fv(this.#rayUniform, false, worldFromScreen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
