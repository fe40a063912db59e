// One object of the scene as a list entry that can be opened and edited.

import { ChangeSender } from './change_sender.js';
import { hexFromLinear, linearFromHex } from './color.js';
import { FormField, numberInput } from './form_field.js';
import { mergePatch } from './merge_patch.js';

// What the service takes for an object that has no material of its own.
const DEFAULT_MATERIAL = { base_color: [0.8, 0.8, 0.8], metallic: 0, roughness: 0.5, emissive: [0, 0, 0] };

export class ObjectEditor {
  #api;
  #object;
  #heard = 0;
  #fields = new Map();
  #sender;

  /**
   * @param {HTMLTemplateElement} template of one entry
   * @param {object} object the service's JSON
   * @param {import('./scene_api.js').SceneApi} api
   * @param {(editor: ObjectEditor) => void} onDelete
   */
  constructor(template, object, api, onDelete) {
    this.#api = api;
    this.node = template.content.firstElementChild.cloneNode(true);
    const each = (told) => (changes, error) => changes.forEach((value, pointer) => told(this.#fields.get(pointer), value, error));
    this.#sender = new ChangeSender((changes) => this.#send(changes), {
      accepted: (changes) => {
        changes.forEach((value, pointer) => this.#fields.get(pointer).accept(value));
        this.#show(this.#object);
      },
      refused: each((field, value, error) => field.complain(error.message)),
      delayed: each((field, value, error) => field.complain(`not sent yet, ${error.message}`)),
    });
    this.#connect();
    this.part('delete').addEventListener('click', () => onDelete(this));
    this.show(object);
  }

  get object() {
    return this.#object;
  }

  part(name) {
    return this.node.querySelector(`[data-part="${name}"]`);
  }

  close() {
    this.#sender.close();
    this.node.remove();
  }

  /** The service tells what the object is like now. */
  show(object) {
    this.#heard += 1;
    this.#show(object);
  }

  /** Says below the object what is wrong with all of it; nothing when the text is empty. */
  complain(text) {
    const place = this.part('complaint');
    if (place.textContent !== text) place.textContent = text;
  }

  /** Why the renderer cannot draw it, or nothing. */
  showSceneError(text) {
    const place = this.part('scene-error');
    if (place.textContent !== text) place.textContent = text;
  }

  async #send(changes) {
    const heard = this.#heard;
    const object = await this.#api.patchObject(this.#object.id, mergePatch(changes, this.#object));
    if (heard === this.#heard) this.#object = object;   // else the events have told what is as new, or newer
  }

  #show(object) {
    this.#object = object;
    const isModel = object.mesh.startsWith('asset:');
    const material = object.material ?? DEFAULT_MATERIAL;
    this.part('id').textContent = object.id;
    this.part('mesh').textContent = object.visible ? object.mesh : `${object.mesh}, hidden`;
    this.part('own-material-row').hidden = !isModel;
    this.part('material').disabled = isModel && object.material === null;
    const values = { '/visible': object.visible, '/material': object.material === null ? null : {} };
    object.position.forEach((value, axis) => { values[`/position/${axis}`] = value; });
    for (const [name, value] of Object.entries(material)) values[`/material/${name}`] = value;
    for (const [pointer, field] of this.#fields) field.show(values[pointer]);
  }

  #connect() {
    ['x', 'y', 'z'].forEach((axis, i) => {
      this.#field(`/position/${i}`, axis, [this.part(axis)], 'position-complaints', numberInput(this.part(axis)));
    });
    this.#checkbox('/visible', 'Visible', 'visible', (visible) => visible);
    this.#checkbox('/material', 'Own materials', 'own-material', (material) => material === null, (own) => (own ? null : {}));
    const color = this.part('base-color');
    this.#field('/material/base_color', 'Base colour', [color], 'material-complaints', {
      read: () => linearFromHex(color.value), write: (value) => { color.value = hexFromLinear(value); },
    });
    this.#slider('/material/metallic', 'Metallic', 'metallic');
    this.#slider('/material/roughness', 'Roughness', 'roughness');
    this.#emissive();
  }

  #field(pointer, label, controls, complaints, { read, write }) {
    this.#fields.set(pointer, new FormField({
      controls, label, read, write, complaints: this.part(complaints),
      changed: (value) => this.#sender.put(pointer, value), reverted: () => this.#sender.forget(pointer),
    }));
  }

  #checkbox(pointer, label, name, isChecked, valueOf = (checked) => checked) {
    const box = this.part(name);
    this.#field(pointer, label, [box], 'material-complaints', {
      read: () => valueOf(box.checked), write: (value) => { box.checked = isChecked(value); },
    });
  }

  #slider(pointer, label, name) {
    const [slider, output] = [this.part(name), this.part(`${name}-value`)];
    const say = (value) => { output.textContent = value.toFixed(2); };
    slider.addEventListener('input', () => say(Number(slider.value)));
    this.#field(pointer, label, [slider], 'material-complaints', {
      read: () => Number(slider.value),
      write: (value) => { slider.value = value; say(value); },
    });
  }

  /** A colour of full brightness times a strength: light has no upper end. */
  #emissive() {
    const [color, strength, output] = ['emissive-color', 'emissive-strength', 'emissive-value'].map((name) => this.part(name));
    const say = (value) => { output.textContent = value.toFixed(2); };
    strength.addEventListener('input', () => say(Number(strength.value)));
    this.#field('/material/emissive', 'Emissive', [color, strength], 'material-complaints', {
      read: () => linearFromHex(color.value).map((value) => value * Number(strength.value)),
      write: (value) => {
        const brightest = Math.max(...value);
        strength.max = Math.max(Number(strength.max), Math.ceil(brightest));
        strength.value = brightest;
        if (brightest > 0) color.value = hexFromLinear(value.map((part) => part / brightest));   // black has no hue
        say(brightest);
      },
    });
  }
}
