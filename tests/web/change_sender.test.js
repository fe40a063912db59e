import assert from 'node:assert/strict';
import test from 'node:test';

import { ChangeSender } from '../../web/change_sender.js';
import { ServiceError } from '../../web/scene_api.js';

const refusal = (...pointers) => new ServiceError('no', 422, pointers);

/** Sends to `answer(changes)` and notes what happens; `idle` resolves when nothing has happened for a while. */
function sending(answer, intervalMs = 5) {
  const log = [];
  const note = (kind) => (changes) => log.push([kind, Object.fromEntries(changes)]);
  const send = async (changes) => {
    log.push(['sent', Object.fromEntries(changes)]);
    await answer(changes);
  };
  const sender = new ChangeSender(send, { accepted: note('accepted'), refused: note('refused'), delayed: note('delayed') }, intervalMs);
  return { sender, log, of: (kind) => log.filter(([other]) => other === kind).map(([, changes]) => changes) };
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

async function until(condition) {
  for (let i = 0; i < 400 && !condition(); i += 1) await pause(5);
  assert.ok(condition(), String(condition));
}

test('one request at a time, the newest values in the next, the last one always', async () => {
  let running = 0;
  const { sender, of } = sending(async () => {
    running += 1;
    assert.equal(running, 1);
    await pause(10);
    running -= 1;
  });
  for (let i = 0; i <= 60; i += 1) {
    sender.put('/a', i);
    await pause(1);
  }
  await until(() => of('accepted').at(-1)?.['/a'] === 60);
  assert.ok(of('sent').length < 30, `${of('sent').length} requests`);
});

test('not more often than the interval', async () => {
  const { sender, of } = sending(async () => {}, 50);
  const start = performance.now();
  while (performance.now() - start < 160) {
    sender.put('/a', performance.now());
    await pause(2);
  }
  sender.put('/a', 'last');
  await until(() => of('accepted').at(-1)?.['/a'] === 'last');
  const elapsed = performance.now() - start;
  assert.ok(of('sent').length <= Math.floor(elapsed / 50) + 2, `${of('sent').length} requests in ${elapsed} ms`);
});

test('what the service does not complain about is sent again without the rest', async () => {
  const { sender, of } = sending(async (changes) => {
    if (changes.has('/position/0')) throw refusal('/position/0');
  });
  sender.put('/position/0', 1e9);
  sender.put('/material/metallic', 1);
  await until(() => of('accepted').length === 1);
  assert.deepEqual(of('refused'), [{ '/position/0': 1e9 }]);
  assert.deepEqual(of('accepted'), [{ '/material/metallic': 1 }]);
});

test('a refusal that names no value is about all of them and ends there', async () => {
  const { sender, of } = sending(async () => { throw refusal(); });
  sender.put('/a', 1);
  sender.put('/b', 2);
  await until(() => of('refused').length === 1);
  await pause(30);
  assert.deepEqual([of('sent').length, of('refused')], [1, [{ '/a': 1, '/b': 2 }]]);
});

test('an unreachable service gets it later, with what is newer', async () => {
  let down = true;
  const { sender, of } = sending(async () => {
    if (down) throw new ServiceError('the service cannot be reached', null);
  });
  sender.put('/a', 1);
  sender.put('/b', 1);
  await until(() => of('delayed').length === 1);
  down = false;
  sender.put('/b', 2);
  await until(() => of('accepted').length === 1);
  assert.deepEqual(of('accepted'), [{ '/a': 1, '/b': 2 }]);
});

test('closed, it sends nothing any more', async () => {
  const { sender, of } = sending(async () => pause(10));
  sender.put('/a', 1);
  await until(() => of('sent').length === 1);
  sender.put('/a', 2);
  sender.close();
  await pause(40);
  assert.equal(of('sent').length, 1);
});

test('a complaint concerns a value, its parts and its whole', () => {
  const error = refusal('/material/base_color/0');
  assert.ok(error.concerns('/material/base_color') && error.concerns('/material'));
  assert.ok(!error.concerns('/material/base') && !error.concerns('/material/metallic') && !error.concerns('/position/0'));
});
