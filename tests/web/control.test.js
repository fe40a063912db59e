import assert from 'node:assert/strict';
import test from 'node:test';

import { hexFromLinear, linearFromHex, linearFromSrgb, srgbFromLinear } from '../../web/color.js';
import { where } from '../../web/light_list.js';
import { mergePatch } from '../../web/merge_patch.js';
import { placedAhead } from '../../web/placement.js';
import { stageRows, statsLine } from '../../web/stage_times.js';

test('sRGB and linear', () => {
  assert.ok(Math.abs(linearFromSrgb(0.5) - 0.21404) < 1e-5);
  for (let i = 0; i <= 100; i += 1) assert.ok(Math.abs(srgbFromLinear(linearFromSrgb(i / 100)) - i / 100) < 1e-6);
  assert.deepEqual(linearFromHex('#ff8000'), [1, 0.21586, 0]);
  for (let code = 0; code < 256; code += 1) {
    const hex = `#${code.toString(16).padStart(2, '0').repeat(3)}`;
    assert.equal(hexFromLinear(linearFromHex(hex)), hex);
  }
  assert.equal(hexFromLinear([-1, 0.5, 7]), '#00bcff');
});

test('a merge patch of single values', () => {
  const object = { position: [1, 2, 3], material: null };
  const patch = (...changes) => mergePatch(new Map(changes), object);
  assert.deepEqual(patch(['/position/1', 9]), { position: [1, 9, 3] });
  assert.deepEqual(patch(['/position/1', 9], ['/position/0', 0]), { position: [0, 9, 3] });
  assert.deepEqual(patch(['/visible', false]), { visible: false });
  assert.deepEqual(patch(['/material', {}], ['/material/metallic', 1]), { material: { metallic: 1 } });
  assert.deepEqual(patch(['/material/metallic', 1], ['/material', null]), { material: null });
  assert.deepEqual(patch(['/material/base_color', [1, 0, 0]], ['/material/roughness', 0]),
    { material: { base_color: [1, 0, 0], roughness: 0 } });
  assert.deepEqual(object, { position: [1, 2, 3], material: null });
});

test('new objects stand on the ground ahead under a name of their own', () => {
  assert.deepEqual(placedAhead('box', 1.5, new Set()), { id: 'box-1', mesh: 'box', position: [0, -1, -3] });
  assert.deepEqual(placedAhead('teapot', 2, new Set(['teapot-1', 'teapot-2'])), { id: 'teapot-3', mesh: 'teapot', position: [0, -2, -3] });
  const { id, mesh } = placedAhead(`asset:${'x'.repeat(64)}`, 2, new Set());
  assert.deepEqual([id.length, mesh.length], [64, 70]);
  assert.match(id, /^x+-1$/);
});

test('where a light is', () => {
  assert.equal(where([0, 0, -1]), 'ahead, 0° up');
  assert.equal(where([1, 1, 0]), '90° right, 45° up');
  assert.equal(where([-1, -1, -1]), '45° left, 35° down');
});

test('stage times', () => {
  assert.deepEqual(stageRows({ viewers: 0 }), []);
  assert.equal(statsLine({ viewers: 0 }), 'The renderer has not started yet.');
  const stats = { fps: 29.97, frames_dropped: 2, viewers: 1, render_ms: { p50: 20, p95: 30.04, max: 40 },
    stages_ms: { radiance_map: { p50: 1.25, p95: null, max: 3 } } };
  assert.deepEqual(stageRows(stats), [['whole frame', '20.0', '30.0'], ['radiance map', '1.3', '–']]);
  assert.equal(statsLine(stats), '30.0 frames a second, 2 dropped, 1 viewer.');
});
