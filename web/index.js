// The stream list: refreshed for as long as the page is looked at.

import { authorized, controlUrl, problemText, streamsUrl, viewUrl } from './service.js';

const REFRESH_MS = 3000;
const SOURCES = {
  live: 'Live', connecting: 'Waiting for the source', lost: 'Source lost', failed: 'Source failed', idle: 'No source',
};
const LEVELS = { live: 'ok', connecting: 'busy', lost: 'warning', failed: 'error', idle: 'warning' };

async function refresh() {
  if (document.hidden) return;
  const message = document.getElementById('message');
  try {
    const response = await fetch(streamsUrl(), { headers: authorized(), signal: AbortSignal.timeout(10_000) });
    if (!response.ok) throw new Error(await problemText(response));
    const body = await response.json();
    const streams = Array.isArray(body) ? body : body.streams;
    document.getElementById('streams').replaceChildren(...streams.map(item));
    message.textContent = streams.length ? '' : 'No stream yet. Start one with: mr360 serve --source URL';
  } catch (error) {
    message.textContent = `The list cannot be loaded: ${error.message}`;
  }
}

function item({ name, state, detail, output, viewers }) {
  const link = document.createElement('a');
  link.href = viewUrl(name);
  link.dataset.level = LEVELS[state] ?? 'busy';
  const size = output ? `${output.width} × ${output.height}` : null;
  const audience = viewers === 1 ? '1 viewer' : `${viewers ?? 0} viewers`;
  const facts = [SOURCES[state] ?? state, state === 'live' ? null : detail, size, audience];
  link.append(span('name', name), span('dot', ''), span('facts', facts.filter(Boolean).join(' · ')));
  const control = document.createElement('a');
  control.href = controlUrl(name);
  control.className = 'control';
  control.textContent = 'Control';
  control.setAttribute('aria-label', `Control ${name}`);
  const row = document.createElement('li');
  row.append(link, control);
  return row;
}

function span(className, text) {
  const node = document.createElement('span');
  node.className = className;
  node.textContent = text;
  return node;
}

refresh();
setInterval(refresh, REFRESH_MS);
document.addEventListener('visibilitychange', refresh);
