// The part of the service's REST interface that edits a scene.

import { authorized, eventsUrl, problemText, streamsUrl } from './service.js';

const ANSWER_MS = 10_000;
const MAX_ATTEMPTS = 5;
const PROXY_STATUSES = [502, 503, 504];

export const lightsUrl = (stream) => new URL('lights', eventsUrl(stream)).href;

/** What the service refused and why; `status` is null when it could not be asked. */
export class ServiceError extends Error {
  /** @param {string[]} pointers JSON pointers of the values that are wrong, if the service named them */
  constructor(message, status, pointers = []) {
    super(message);
    this.status = status;
    this.pointers = pointers;
  }

  /** It may work later without any change. */
  get unreachable() {
    return this.status === null || PROXY_STATUSES.includes(this.status);
  }

  /** Whether the service complains about the value at this pointer, one of its parts or the whole it belongs to. */
  concerns(pointer) {
    return this.pointers.some((wrong) => `${wrong}/`.startsWith(`${pointer}/`) || `${pointer}/`.startsWith(`${wrong}/`));
  }
}

/** Every method throws ServiceError. Objects, scenes, assets and statistics are the service's JSON as it is. */
export class SceneApi {
  #stream;

  constructor(stream) {
    this.#stream = `${streamsUrl()}/${encodeURIComponent(stream)}`;
  }

  async addObject(object) {
    return (await request('POST', `${this.#stream}/objects`, object)).body;
  }

  /** RFC 7396. @returns the whole object as it is now */
  async patchObject(id, patch) {
    return (await request('PATCH', this.#object(id), patch)).body;
  }

  async deleteObject(id) {
    await request('DELETE', this.#object(id));
  }

  /** The scene can only be replaced as a whole, so on top of whatever others have just made of it. */
  async setCameraHeight(metres) {
    for (let attempt = 1; ; attempt += 1) {
      const { body: scene, etag } = await request('GET', `${this.#stream}/scene`);
      try {
        return (await request('PUT', `${this.#stream}/scene`, { ...scene, camera_height: metres }, { 'If-Match': etag })).body;
      } catch (error) {
        if (error.status !== 412 || attempt === MAX_ATTEMPTS) throw error;
      }
    }
  }

  async stats() {
    return (await request('GET', `${this.#stream}/stats`)).body;
  }

  async assets() {
    return (await request('GET', new URL('assets', streamsUrl()).href)).body;
  }

  #object(id) {
    return `${this.#stream}/objects/${encodeURIComponent(id)}`;
  }
}

async function request(method, url, body, headers = {}) {
  let response;
  try {
    response = await fetch(url, {
      method, body: body && JSON.stringify(body), signal: AbortSignal.timeout(ANSWER_MS),
      headers: authorized(body ? { 'Content-Type': 'application/json', ...headers } : headers),
    });
  } catch (error) {
    const silent = error.name === 'TimeoutError';
    throw new ServiceError(silent ? 'the service did not answer' : 'the service cannot be reached', null);
  }
  if (!response.ok) throw await refusal(response);
  const etag = response.headers.get('ETag');
  return { etag, body: response.status === 204 ? null : await response.json() };
}

async function refusal(response) {
  const problem = await response.clone().json().catch(() => null);
  const pointers = (problem?.errors ?? []).map(({ pointer }) => pointer).filter((pointer) => pointer && pointer !== '/');
  return new ServiceError(await problemText(response), response.status, pointers);
}
