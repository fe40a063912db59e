import assert from 'node:assert/strict';
import test from 'node:test';

import { restartFragment, restartedAnswer } from '../../web/ice_restart.js';

const lines = (...all) => all.map((line) => `${line}\r\n`).join('');
const LOCAL = lines('v=0', 'a=group:BUNDLE 0 1', 'm=video 9 UDP/TLS/RTP/SAVPF 96 97', 'a=candidate:1 1 udp 1 192.0.2.1 5 typ host',
  'a=ice-ufrag:mine', 'a=ice-pwd:secret', 'a=mid:0', 'a=recvonly', 'm=audio 9 UDP/TLS/RTP/SAVPF 111', 'a=ice-ufrag:mine', 'a=mid:1');
const REMOTE = lines('v=0', 'm=video 4000 UDP/TLS/RTP/SAVPF 96', 'a=mid:0', 'a=candidate:1 1 udp 1 192.0.2.9 4000 typ host',
  'a=end-of-candidates', 'a=ice-ufrag:old', 'a=ice-pwd:old', 'm=audio 4000 UDP/TLS/RTP/SAVPF 111', 'a=ice-ufrag:old', 'a=ice-pwd:old');

test('the fragment has the credentials and candidates of the shared transport and nothing else', () => {
  assert.equal(restartFragment(LOCAL), lines('m=video 9 UDP/TLS/RTP/SAVPF 0', 'a=ice-ufrag:mine', 'a=ice-pwd:secret', 'a=mid:0',
    'a=candidate:1 1 udp 1 192.0.2.1 5 typ host'));
});

test('the answer has the new credentials everywhere and only the new candidates', () => {
  const fragment = lines('m=video 9 UDP/TLS/RTP/SAVPF 0', 'a=mid:0', 'a=ice-ufrag:new', 'a=ice-pwd:newer',
    'a=candidate:2 1 udp 1 192.0.2.10 4001 typ host', 'a=end-of-candidates');
  assert.equal(restartedAnswer(REMOTE, fragment), lines('v=0', 'm=video 4000 UDP/TLS/RTP/SAVPF 96', 'a=mid:0', 'a=ice-ufrag:new',
    'a=ice-pwd:newer', 'a=candidate:2 1 udp 1 192.0.2.10 4001 typ host', 'a=end-of-candidates',
    'm=audio 4000 UDP/TLS/RTP/SAVPF 111', 'a=ice-ufrag:new', 'a=ice-pwd:newer'));
});

test('a fragment without credentials restarts nothing', () => {
  assert.equal(restartedAnswer(REMOTE, lines('a=mid:0', 'a=ice-ufrag:new')), null);
});
