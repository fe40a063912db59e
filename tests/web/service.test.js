import assert from 'node:assert/strict';
import test from 'node:test';

const PAGE = 'https://mr360.example/view/live';
let loaded = 0;

/** service.js as a page at this address loads it. */
async function at(fragment, stored = {}) {
  const moved = [];
  globalThis.location = { hash: fragment, pathname: '/view/live', search: '?rendition=low', href: PAGE };
  globalThis.history = { state: null, replaceState: (state, title, url) => moved.push(url) };
  globalThis.sessionStorage = {
    getItem: (name) => stored[name] ?? null,
    setItem: (name, value) => { stored[name] = value; },
  };
  try {
    return { service: await import(`../../web/service.js?${loaded += 1}`), moved, stored };
  } finally {
    for (const name of ['location', 'history', 'sessionStorage']) delete globalThis[name];
  }
}

test('the token leaves the address bar, the rest of the fragment stays', async () => {
  const { service, moved, stored } = await at('#token=abc.DEF-1&yaw=30&pitch=-5');
  assert.equal(service.token, 'abc.DEF-1');
  assert.deepEqual(moved, ['/view/live?rendition=low#yaw=30&pitch=-5']);
  assert.deepEqual(Object.values(stored), ['abc.DEF-1']);
  const again = await at('#yaw=30', stored);
  assert.equal(again.service.token, 'abc.DEF-1');
  assert.deepEqual(again.moved, []);
});

test('requests and sockets name the token only if there is one', async () => {
  const { service } = await at('');
  assert.equal(service.token, null);
  assert.deepEqual(service.authorized({ Accept: 'x' }), { Accept: 'x' });
  assert.deepEqual(service.socketProtocols(), []);
  assert.deepEqual(service.authorized({ Accept: 'x' }, 'abc'), { Accept: 'x', Authorization: 'Bearer abc' });
  assert.deepEqual(service.socketProtocols('abc'), ['bearer.abc']);
});

test('a browser that stores nothing keeps the token while the page lives', async () => {
  globalThis.location = { hash: '#token=abc', pathname: '/', search: '', href: PAGE };
  globalThis.history = { replaceState() {} };
  globalThis.sessionStorage = { setItem() { throw new Error('denied'); } };
  assert.equal((await import(`../../web/service.js?${loaded += 1}`)).token, 'abc');
  for (const name of ['location', 'history', 'sessionStorage']) delete globalThis[name];
});

test('the WHEP address carries what the page was asked for', async () => {
  const { service } = await at('');
  const query = (search) => new URL(service.whepUrl('live', search)).search;
  assert.equal(query('?rendition=low&x=1'), '?rendition=low');
  assert.equal(query('?at_most=medium'), '?at_most=medium');
  assert.equal(query(''), '');
});
