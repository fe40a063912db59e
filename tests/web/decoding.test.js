import assert from 'node:assert/strict';
import { test } from 'node:test';

import { withinReach } from '../../web/decoding.js';

const LADDER = [{ name: 'full', width: 2048, height: 1024 }, { name: 'medium', width: 1364, height: 682 }, { name: 'low', width: 1024, height: 512 }];
const playback = (renditions = LADDER) => async () => [{ protocol: 'page' }, { protocol: 'whep', renditions }];
const upTo = (limit) => async ({ width }) => width <= limit;
const URL_ = 'https://host/whep/live';

test('a device that decodes everything asks for nothing', async () => {
  assert.equal(await withinReach(URL_, playback(), upTo(4096)), URL_);
});

test('a weak device asks for what it decodes, the weakest for the smallest', async () => {
  assert.equal(await withinReach(URL_, playback(), upTo(1500)), `${URL_}?at_most=medium`);
  assert.equal(await withinReach(URL_, playback(), upTo(100)), `${URL_}?at_most=low`);
});

test('what the page asks for is kept', async () => {
  for (const query of ['?rendition=full', '?at_most=medium']) {
    assert.equal(await withinReach(URL_ + query, playback(), upTo(100)), URL_ + query);
  }
});

test('a service that does not tell is no obstacle', async () => {
  const broken = async () => { throw new TypeError('failed to fetch'); };
  assert.equal(await withinReach(URL_, broken, upTo(100)), URL_);
  assert.equal(await withinReach(URL_, playback([]), upTo(100)), URL_);
  assert.equal(await withinReach(URL_, playback([{ name: 'full' }, { name: 'low' }]), upTo(100)), URL_);
  assert.equal(await withinReach(URL_, playback(), async () => { throw new TypeError('no such codec'); }), URL_);
});

test('a service that does not answer is not waited for long', async () => {
  assert.equal(await withinReach(URL_, () => new Promise(() => {}), upTo(100)), URL_);
});
