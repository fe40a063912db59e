import assert from 'node:assert/strict';
import test from 'node:test';

import { backoffMs } from '../../web/service.js';
import { iceServersFromLink, retryAfterMs } from '../../web/whep_headers.js';

test('ICE servers of a Link header', () => {
  const header = '<stun:stun.example.net>; rel="ice-server", <turn:turn.example.net?transport=udp>; rel="ice-server"; '
    + 'username="user"; credential="my pass"; credential-type="password", </other>; rel="next"';
  const servers = iceServersFromLink(header);
  assert.deepEqual(servers, [
    { urls: 'stun:stun.example.net' },
    { urls: 'turn:turn.example.net?transport=udp', username: 'user', credential: 'my pass' },
  ]);
  assert.deepEqual(iceServersFromLink(null), []);
  assert.deepEqual(iceServersFromLink('nonsense'), []);
});

test('quoted credentials keep commas and semicolons', () => {
  const [server] = iceServersFromLink('<turn:t>; rel="ice-server"; username="1700000000:a;b"; credential="x,y=="');
  assert.deepEqual(server, { urls: 'turn:t', username: '1700000000:a;b', credential: 'x,y==' });
});

test('Retry-After in seconds and as a date', () => {
  assert.equal(retryAfterMs('7'), 7000);
  assert.equal(retryAfterMs('Thu, 01 Jan 1970 00:01:00 GMT', 15_000), 45_000);
  assert.equal(retryAfterMs('Thu, 01 Jan 1970 00:00:00 GMT', 15_000), 0);
  assert.equal(retryAfterMs('soon'), null);
  assert.equal(retryAfterMs(null), null);
});

test('pauses grow to ten seconds and spread out', () => {
  assert.deepEqual([1, 2, 3, 4, 5, 50].map((attempt) => backoffMs(attempt, 0.5)), [1000, 2000, 4000, 8000, 10_000, 10_000]);
  assert.equal(backoffMs(1, 0), 800);
  assert.ok(Math.abs(backoffMs(1, 1) - 1200) < 1e-6);
});
