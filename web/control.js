// The control page: the live panorama beside what stands in it, for the crew.

import { ChangeSender } from './change_sender.js';
import { StreamEvents } from './events.js';
import { FormField, numberInput } from './form_field.js';
import { LightList } from './light_list.js';
import { LiveVideo } from './live_video.js';
import { ObjectList } from './object_list.js';
import { SceneApi, lightsUrl } from './scene_api.js';
import { eventsUrl, viewUrl } from './service.js';
import { stageRows, statsLine } from './stage_times.js';

const STATUS_MS = 250;
const STATS_MS = 1000;

const element = (id) => document.getElementById(id);

class Control {
  stream = decodeURIComponent(location.pathname.replace(/\/+$/, '').split('/').pop());

  constructor() {
    this.api = new SceneApi(this.stream);
    this.events = new StreamEvents(eventsUrl(this.stream));
    this.live = new LiveVideo(element('picture'), this.stream, this.events);
    this.objects = new ObjectList(this.api);
    this.lights = new LightList(element('lights'), element('lights-note'), lightsUrl(this.stream));
    this.cameraHeight = this.#cameraHeightField();
    this.#connectParts();
    this.#connectPage();
  }

  start() {
    this.live.start();
    this.events.start();
    this.lights.start();
    this.objects.loadAssets();
    this.statusTimer = setInterval(() => this.#showStatus(), STATUS_MS);
    this.statsTimer = setInterval(() => this.#showStats(), STATS_MS);
  }

  stop() {
    clearInterval(this.statusTimer);
    clearInterval(this.statsTimer);
    this.lights.stop();
    this.events.close();
    this.live.stop();
  }

  #cameraHeightField() {
    const input = element('camera-height');
    const each = (told) => (changes, error) => told([...changes.values()][0], error);
    const sender = new ChangeSender((changes) => this.api.setCameraHeight(changes.get('/camera_height')), {
      accepted: each((value) => field.accept(value)),
      refused: each((value, error) => field.complain(error.message)),
      delayed: each((value, error) => field.complain(`not sent yet, ${error.message}`)),
    });
    const field = new FormField({
      controls: [input], complaints: element('camera-complaints'), label: 'Camera height', ...numberInput(input),
      changed: (value) => sender.put('/camera_height', value), reverted: () => sender.forget('/camera_height'),
    });
    return field;
  }

  #connectParts() {
    this.live.addEventListener('change', () => this.#showStatus());
    this.events.addEventListener('message', ({ detail }) => this.#hear(detail));
    this.events.addEventListener('lost', () => setText('events-note', 'Not connected: what others change does not show.'));
    this.events.addEventListener('reopened', () => {
      setText('events-note', '');
      this.objects.loadAssets();
    });
    element('retry').addEventListener('click', () => this.live.start());
  }

  #connectPage() {
    document.title = `${this.stream} · mr360 control`;
    element('stream-name').textContent = this.stream;
    element('view').href = viewUrl(this.stream);
    addEventListener('online', () => this.live.start());
    addEventListener('pointerdown', () => this.live.play());
    document.addEventListener('visibilitychange', () => !document.hidden && this.objects.loadAssets());
    addEventListener('pagehide', () => this.stop());
    addEventListener('pageshow', ({ persisted }) => persisted && this.start());
  }

  #hear(message) {
    if (message.type === 'object') this.objects.show(message.id, message.object);
    if (message.type !== 'scene') return;
    this.objects.showScene(message.scene);
    this.cameraHeight.show(message.scene.camera_height);
    element('camera-height').disabled = false;
  }

  #showStatus() {
    const status = this.live.status();
    document.body.dataset.level = status.level;
    setText('status-title', status.title);
    setText('status-detail', status.detail);
    element('retry').hidden = !status.canRetry;
  }

  async #showStats() {
    if (document.hidden || this.askingStats) return;   // a slow answer is waited for, not asked for again
    this.askingStats = true;
    try {
      const stats = await this.api.stats();
      element('stages').replaceChildren(...stageRows(stats).map(tableRow));
      setText('stats-note', statsLine(stats));
      this.objects.showSceneErrors(stats.scene_errors ?? {});
    } catch (error) {
      setText('stats-note', `The times cannot be read: ${error.message}`);
    } finally {
      this.askingStats = false;
    }
  }
}

function tableRow([name, ...values]) {
  const row = document.createElement('tr');
  const head = document.createElement('th');
  head.scope = 'row';
  head.textContent = name;
  row.append(head);
  for (const value of values) row.insertCell().textContent = value;
  return row;
}

/** Leaves an unchanged text alone, so that a screen reader does not read it again. */
function setText(id, text) {
  const node = element(id);
  if (node.textContent !== text) node.textContent = text;
}

const control = new Control();
window.mr360 = { control };   // for the tests and the curious
control.start();
