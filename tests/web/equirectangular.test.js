import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import test from 'node:test';

import { directionFromUv, uvFromDirection } from '../../web/equirectangular.js';

const { pairs } = JSON.parse(readFileSync(new URL('../data/directions.json', import.meta.url)));

/** Difference of two u, the short way round the seam. */
const seamDistance = (a, b) => Math.abs(((a - b + 1.5) % 1) - 0.5);

test('the data file has pairs', () => assert.ok(pairs.length > 8));

for (const { name, direction, uv } of pairs) {
  test(`uv of ${name}`, () => {
    const [u, v] = uvFromDirection(direction);
    assert.ok(Math.abs(v - uv[1]) < 1e-12, `v ${v}, expected ${uv[1]}`);
    if (Math.hypot(direction[0], direction[2]) > 1e-12) assert.ok(Math.abs(u - uv[0]) < 1e-12, `u ${u}, expected ${uv[0]}`);
  });

  test(`direction of ${name}`, () => {
    const back = directionFromUv(uv);
    direction.forEach((value, i) => assert.ok(Math.abs(back[i] - value) < 1e-12, `${back}, expected ${direction}`));
  });
}

test('length does not matter', () => {
  const [u, v] = uvFromDirection([3, 4, -5]);
  const [u2, v2] = uvFromDirection([0.3, 0.4, -0.5]);
  assert.ok(Math.abs(u - u2) < 1e-15 && Math.abs(v - v2) < 1e-15);
});

test('the poles are finite', () => {
  for (const [direction, pole] of [[[0, 1, 0], 0], [[0, -1, 0], 1]]) {
    const [u, v] = uvFromDirection(direction);
    assert.equal(v, pole);
    assert.ok(u >= 0 && u <= 1);
  }
});

test('round trip over the whole panorama', () => {
  for (let i = 0; i < 64; i++) {
    for (let j = 0; j < 32; j++) {
      const [u, v] = [(i + 0.5) / 64, (j + 0.5) / 32];
      const [u2, v2] = uvFromDirection(directionFromUv([u, v]));
      assert.ok(seamDistance(u, u2) < 1e-12 && Math.abs(v - v2) < 1e-12, `${u}, ${v} became ${u2}, ${v2}`);
    }
  }
});
