// The objects of the scene, as the service has them: add, edit, delete and bring back.

import { ObjectEditor } from './object_editor.js';
import { BUILT_IN_MESHES, placedAhead } from './placement.js';

const element = (id) => document.getElementById(id);

export class ObjectList {
  #api;
  #editors = new Map();
  #scene = null;
  #deleted = null;

  /** @param {import('./scene_api.js').SceneApi} api */
  constructor(api) {
    this.#api = api;
    element('add').addEventListener('submit', (event) => {
      event.preventDefault();
      this.#add();
    });
    element('undo').addEventListener('click', () => this.#undo());
    this.#showMeshes([]);
  }

  /** The whole scene. */
  showScene(scene) {
    this.#scene = scene;
    element('add-button').disabled = false;
    const ids = new Set(scene.objects.map(({ id }) => id));
    for (const id of this.#editors.keys()) if (!ids.has(id)) this.#remove(id);
    for (const object of scene.objects) this.show(object.id, object);
    this.#sayWhetherEmpty();
  }

  /** One object of the scene; null when it has been deleted. */
  show(id, object) {
    if (object === null) this.#remove(id);
    else if (this.#editors.has(id)) this.#editors.get(id).show(object);
    else this.#append(object);
    this.#sayWhetherEmpty();
  }

  /** @param {Object<string, string>} errors object id → why the renderer cannot draw it */
  showSceneErrors(errors) {
    for (const [id, editor] of this.#editors) editor.showSceneError(errors[id] ?? '');
  }

  /** Asks for the models that can be added. */
  async loadAssets() {
    try {
      this.#showMeshes((await this.#api.assets()).map(({ mesh }) => mesh));
      this.#complain('');
    } catch (error) {
      this.#complain(`The models cannot be listed: ${error.message}`);
    }
  }

  #showMeshes(models) {
    const select = element('mesh');
    const meshes = [...BUILT_IN_MESHES, ...models];
    if (meshes.join() === [...select.options].map(({ value }) => value).join()) return;
    const chosen = select.value;
    select.replaceChildren(...meshes.map((mesh) => new Option(mesh.replace(/^asset:/, ''), mesh)));
    if (meshes.includes(chosen)) select.value = chosen;
  }

  async #add() {
    const taken = new Set([...this.#editors.keys(), ...this.#scene.local_scene.map(({ id }) => id)]);
    const { id, ...rest } = placedAhead(element('mesh').value, this.#scene.camera_height, taken);
    try {
      const object = await this.#api.addObject({ id, ...rest }).catch((error) => {
        if (error.status !== 409) throw error;
        return this.#api.addObject(rest);   // somebody else has just taken the name: the service makes one up
      });
      this.#complain('');
      this.show(object.id, object);
      const editor = this.#editors.get(object.id);
      editor.node.open = true;
      editor.part('summary').focus();
    } catch (error) {
      this.#complain(`Not added: ${error.message}`);
    }
  }

  async #delete(editor) {
    const { object } = editor;
    try {
      await this.#api.deleteObject(object.id);
    } catch (error) {
      if (error.status !== 404) {
        editor.complain(`Not deleted: ${error.message}`);
        return;
      }   // somebody else was faster
    }
    this.#deleted = object;
    this.show(object.id, null);
    this.#sayDeleted(`${object.id} is deleted.`);
    element('undo').focus();
  }

  async #undo() {
    try {
      const object = await this.#api.addObject(this.#deleted);
      this.show(object.id, object);
      this.#sayDeleted('');
      this.#editors.get(object.id).part('summary').focus();
    } catch (error) {
      element('deleted').textContent = `${this.#deleted.id} is not back: ${error.message}`;
    }
  }

  #append(object) {
    const editor = new ObjectEditor(element('object'), object, this.#api, () => this.#delete(editor));
    this.#editors.set(object.id, editor);
    element('objects').append(editor.node);
  }

  #remove(id) {
    this.#editors.get(id)?.close();
    this.#editors.delete(id);
  }

  #sayWhetherEmpty() {
    element('no-objects').hidden = this.#editors.size > 0;
  }

  #sayDeleted(text) {
    element('deleted').textContent = text;
    element('undo').hidden = text === '';
  }

  #complain(text) {
    if (element('add-complaint').textContent !== text) element('add-complaint').textContent = text;
  }
}
