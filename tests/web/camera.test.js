import assert from 'node:assert/strict';
import test from 'node:test';

import {
  RADIANS, multiply, perspective, rotationFromDevice, rotationFromTransform, rotationFromYawPitch, worldFromScreen,
  yawOfRotation,
} from '../../web/camera.js';
import { uvFromDirection } from '../../web/equirectangular.js';
import { lookFromHash } from '../../web/look.js';

const apply = (m, [x, y, z]) => [0, 1, 2].map((row) => m[row] * x + m[3 + row] * y + m[6 + row] * z);
const forward = (m) => apply(m, [0, 0, -1]);
const unit = (d) => d.map((value) => value / Math.hypot(...d));

function near(actual, expected, tolerance = 1e-9) {
  assert.equal(actual.length, expected.length);
  actual.forEach((value, i) => assert.ok(Math.abs(value - expected[i]) <= tolerance, `${actual}, expected ${expected}`));
}

function isRotation(m) {
  near(multiply([m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]], m), [1, 0, 0, 0, 1, 0, 0, 0, 1]);
  const [a, b, c] = [m.slice(0, 3), m.slice(3, 6), m.slice(6, 9)];
  near([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], c);
}

test('yaw 0, pitch 0 is no rotation', () => near(rotationFromYawPitch(0, 0), [1, 0, 0, 0, 1, 0, 0, 0, 1], 0));

test('yaw turns to the right, pitch up, both along the panorama', () => {
  for (const [yaw, pitch] of [[90, 0], [-90, 0], [180, 0], [30, 40], [-120, -70], [10, 90]]) {
    const m = rotationFromYawPitch(yaw * RADIANS, pitch * RADIANS);
    isRotation(m);
    const [u, v] = uvFromDirection(forward(m));
    near([v], [0.5 - pitch / 180]);
    if (Math.abs(pitch) < 90) near([Math.cos(2 * Math.PI * u)], [Math.cos(2 * Math.PI * (0.5 + yaw / 360))]);
    if (Math.abs(yaw) < 180 && Math.abs(pitch) < 90) near([yawOfRotation(m)], [yaw * RADIANS]);
  }
  near(forward(rotationFromYawPitch(90 * RADIANS, 0)), [1, 0, 0]);
  near(forward(rotationFromYawPitch(0, 90 * RADIANS)), [0, 1, 0]);
});

test('the edges of the screen are half the field of view away', () => {
  const rays = worldFromScreen(perspective(80 * RADIANS, 1.5), [1, 0, 0, 0, 1, 0, 0, 0, 1]);
  near(apply(rays, [0, 0, 1]), [0, 0, -1], 1e-6);
  near(apply(rays, [0, 1, 1]), [0, Math.tan(40 * RADIANS), -1], 1e-6);
  near(apply(rays, [1, 0, 1]), [1.5 * Math.tan(40 * RADIANS), 0, -1], 1e-6);
});

test('rays of an off-axis projection end where the projection puts them', () => {
  // tangents of a left eye: 54° out, 40° in, 44° up, 55° down
  const [l, r, t, b] = [-54, 40, 44, -55].map((angle) => Math.tan(angle * RADIANS));
  const projection = [2 / (r - l), 0, 0, 0, 0, 2 / (t - b), 0, 0, (r + l) / (r - l), (t + b) / (t - b), -1, -1, 0, 0, -0.2, 0];
  const turned = rotationFromYawPitch(0.7, -0.2);
  const rays = worldFromScreen(projection, turned);
  near(apply(rays, [-1, 1, 1]), apply(turned, [l, t, -1]), 1e-6);
  near(apply(rays, [1, -1, 1]), apply(turned, [r, b, -1]), 1e-6);
});

test('the translation of a pose is dropped', () => {
  const pose = [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 5, 6, 7, 1];
  assert.deepEqual(rotationFromTransform(pose), [0, 0, -1, 0, 1, 0, 1, 0, 0]);
});

test('a phone held upright looks through its back', () => {
  near(forward(rotationFromDevice(0, 90, 0, 0)), [0, 0, -1]);             // facing north
  near(apply(rotationFromDevice(0, 90, 0, 0), [0, 1, 0]), [0, 1, 0]);     // its top is up
  near(forward(rotationFromDevice(-90, 90, 0, 0)), [1, 0, 0]);            // turned to the east: right
  near(forward(rotationFromDevice(0, 0, 0, 0)), [0, -1, 0]);              // flat on the table: the floor
  near(forward(rotationFromDevice(0, 120, 0, 0)), [0, 0.5, -Math.sqrt(0.75)]);   // leaned back: 30° up
  isRotation(rotationFromDevice(33, 71, -12, 90));
});

test('a phone held sideways keeps the horizon level', () => {
  // Landscape, screen turned by 90°: the device's top points left, the picture's right is the device's bottom.
  const m = rotationFromDevice(90, 0, -90, 90);
  near([unit(apply(m, [1, 0, 0]))[1]], [0]);
  near(apply(m, [0, 1, 0]), [0, 1, 0]);
});

test('the address gives the first look', () => {
  near(Object.values(lookFromHash('#yaw=90&pitch=-10&fov=60')), [90 * RADIANS, -10 * RADIANS, 60 * RADIANS]);
  assert.deepEqual(lookFromHash(''), {});
  assert.deepEqual(lookFromHash('#yaw=north&pitch=&fov=NaN&roll=3'), {});
});
