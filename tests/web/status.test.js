import assert from 'node:assert/strict';
import test from 'node:test';

import { sourceFromMessage } from '../../web/events.js';
import { describe } from '../../web/status.js';

const CONNECTED = { state: 'connected', reason: null, detail: null };

function say(facts) {
  return describe({ stream: 'live', whep: CONNECTED, retryInS: 0, source: null, hasPicture: true, silentMs: 0, ...facts });
}

test('playing', () => assert.deepEqual([say({}).level, say({}).title], ['ok', 'Live']));

test('waiting says why, and when it tries again', () => {
  const whep = (reason, detail) => ({ state: 'waiting', reason, detail });
  const unreachable = say({ whep: whep('unreachable', 'the server cannot be reached'), retryInS: 3.2 });
  assert.equal(unreachable.title, 'Server not reachable');
  assert.equal(unreachable.detail, 'The server cannot be reached. Reconnecting in 4 s.');
  assert.ok(unreachable.canRetry);
  assert.match(say({ whep: whep('not-found', 'x'), retryInS: 1 }).detail, /no stream named “live”.*Reconnecting in 1 s/);
  assert.equal(say({ whep: whep('busy', '8 of 8 viewers'), retryInS: 7 }).title, 'The server is full');
  assert.match(say({ whep: whep('disconnected', 'x'), retryInS: -0.1 }).detail, /Reconnecting in 0 s/);
});

test('a browser without a video codec of ours is told so and not to retry', () => {
  const status = say({ whep: { state: 'unsupported', reason: 'no-codec', detail: 'the server and this browser share no video codec' } });
  assert.equal(status.level, 'error');
  assert.match(status.detail, /H\.264 or VP8.*share no video codec/);
  assert.ok(!status.canRetry);
});

test('the source has its own words', () => {
  const lost = say({ source: { state: 'lost', detail: 'rtsp://camera: connection refused' } });
  assert.deepEqual([lost.level, lost.title], ['warning', 'Source lost']);
  assert.match(lost.detail, /stands still.*rtsp:\/\/camera: connection refused\./);
  assert.equal(say({ source: { state: 'connecting', detail: null }, hasPicture: false }).level, 'busy');
  assert.equal(say({ source: { state: 'failed', detail: 'no OpenGL' } }).level, 'error');
  assert.equal(say({ source: { state: 'idle', detail: null } }).title, 'No source');
  assert.equal(say({ source: { state: 'live', detail: null } }).title, 'Live');
});

test('a connection without pictures is not called live', () => {
  assert.equal(say({ hasPicture: false }).title, 'Waiting for the first picture…');
  assert.equal(say({ silentMs: 5000 }).title, 'Picture stopped');
});

test('messages of the event socket', () => {
  assert.deepEqual(sourceFromMessage({ type: 'source', state: 'lost', detail: 'gone', flags: [] }), { state: 'lost', detail: 'gone' });
  assert.equal(sourceFromMessage({ type: 'viewers', count: 2 }), null);
});
