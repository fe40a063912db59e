// Rotations and projections of the view. Matrices are column-major as in WebGL and WebXR: 3×3 as 9 numbers, 4×4 as 16.

export const RADIANS = Math.PI / 180;

/**
 * Rotation of a head that turns by yaw, then looks up by pitch.
 *
 * @param {number} yaw radians, positive to the right
 * @param {number} pitch radians, positive is up
 * @returns {number[]} world_from_view, 3×3: the columns are where the view's right, up and back point
 */
export function rotationFromYawPitch(yaw, pitch) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return [cy, 0, sy, -sp * sy, cp, sp * cy, -cp * sy, -sp, cp * cy];
}

/** Product of two square matrices of the same size, 3×3 or 4×4. */
export function multiply(a, b) {
  const n = Math.sqrt(a.length);
  const product = new Array(n * n).fill(0);
  for (let column = 0; column < n; column++) {
    for (let row = 0; row < n; row++) {
      for (let k = 0; k < n; k++) product[column * n + row] += a[k * n + row] * b[column * n + k];
    }
  }
  return product;
}

/** The rotation in a rigid 4×4 transform, 3×3. The translation is dropped: a panorama is infinitely far away. */
export function rotationFromTransform(m) {
  return [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]];
}

/**
 * Perspective projection, only as far as rays need it.
 *
 * @param {number} verticalFov radians
 * @param {number} aspect width / height
 * @returns {number[]} 4×4
 */
export function perspective(verticalFov, aspect) {
  const f = 1 / Math.tan(verticalFov / 2);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, -1, -1, 0, 0, -0.2, 0];
}

/**
 * What turns a place on the screen into a direction in the world, for symmetric and for off-axis (headset) projections.
 *
 * @param {number[]} projection clip_from_view, 4×4
 * @param {number[]} worldFromView 3×3
 * @returns {Float32Array} 3×3; times (x, y, 1) in normalised device coordinates gives a ray, not of unit length
 */
export function worldFromScreen(projection, worldFromView) {
  const viewFromScreen = [1 / projection[0], 0, 0, 0, 1 / projection[5], 0,
    projection[8] / projection[0], projection[9] / projection[5], -1];
  return new Float32Array(multiply(worldFromView, viewFromScreen));
}

/**
 * Rotation of a hand-held device whose back is the camera.
 *
 * Angles are those of DeviceOrientationEvent (degrees): the device turned about its own Z by alpha, X by beta, Y by gamma
 * in a frame of X east, Y north, Z up; north becomes forward here. screenAngle is screen.orientation.angle.
 *
 * @returns {number[]} world_from_view, 3×3
 */
export function rotationFromDevice(alpha, beta, gamma, screenAngle) {
  const [a, b, c, s] = [alpha, beta, gamma, -screenAngle].map((angle) => angle * RADIANS);
  const aboutZ = (angle) => [Math.cos(angle), Math.sin(angle), 0, -Math.sin(angle), Math.cos(angle), 0, 0, 0, 1];
  const aboutX = [1, 0, 0, 0, Math.cos(b), Math.sin(b), 0, -Math.sin(b), Math.cos(b)];
  const aboutY = [Math.cos(c), 0, -Math.sin(c), 0, 1, 0, Math.sin(c), 0, Math.cos(c)];
  const worldFromEarth = [1, 0, 0, 0, 0, -1, 0, 1, 0];   // east → +X, north → -Z, up → +Y
  const earthFromDevice = multiply(multiply(aboutZ(a), aboutX), aboutY);
  return multiply(worldFromEarth, multiply(earthFromDevice, aboutZ(s)));
}

/** Yaw (radians, positive to the right) of the direction that a view looks in. */
export function yawOfRotation(worldFromView) {
  return Math.atan2(-worldFromView[6], worldFromView[8]);
}
