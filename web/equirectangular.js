// Directions and panorama coordinates: right-handed, +Y up, -Z forward, metres.
//
// u = 0.5 + atan2(x, -z) / 2π, v = acos(y) / π, row 0 is up. u = 0.5 is forward, u = 0.75 is +X (right).

/**
 * Panorama coordinates of a direction.
 *
 * acos is written as atan2 because acos loses half of its digits near the poles.
 *
 * @param {number[]} direction x, y, z of any length but zero
 * @returns {number[]} u in [0, 1], v in [0, 1]
 */
export function uvFromDirection([x, y, z]) {
  return [
    0.5 + Math.atan2(x, 0 - z) / (2 * Math.PI),
    Math.atan2(Math.hypot(x, z), y) / Math.PI,
  ];
}

/**
 * Unit direction of a place on the panorama.
 *
 * @param {number[]} uv u in [0, 1], v in [0, 1]
 * @returns {number[]} x, y, z
 */
export function directionFromUv([u, v]) {
  const azimuth = (u - 0.5) * 2 * Math.PI;
  const polar = v * Math.PI;
  return [Math.sin(polar) * Math.sin(azimuth), Math.cos(polar), -Math.sin(polar) * Math.cos(azimuth)];
}

/** The same mapping for a fragment shader: vec2 uvFromDirection(vec3), any length but zero. */
export const GLSL_UV_FROM_DIRECTION = `
const float PI = 3.14159265358979;
vec2 uvFromDirection(vec3 d) {
  float horizontal = length(d.xz);
  // Straight up or down atan(0, 0) is undefined; any azimuth will do there, a NaN will not.
  float azimuth = horizontal > 0.0 ? atan(d.x, -d.z) : 0.0;
  return vec2(0.5 + azimuth / (2.0 * PI), atan(horizontal, d.y) / PI);
}`;
