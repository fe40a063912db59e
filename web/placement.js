// Where a new object stands and what it is called.

export const BUILT_IN_MESHES = ['sphere', 'box', 'cylinder', 'teapot'];

const AHEAD_M = 3;
const CENTRED = ['sphere', 'box', 'cylinder'];   // 1 m high around their origin; a teapot or a model stands on its own
const LONGEST_ID = 64;

/** An object that stands on the ground straight ahead. @param {Set<string>} taken ids in use */
export function placedAhead(mesh, cameraHeight, taken) {
  const lift = CENTRED.includes(mesh) ? 0.5 : 0;
  return { id: freeId(mesh.replace(/^asset:/, ''), taken), mesh, position: [0, lift - cameraHeight, -AHEAD_M] };
}

function freeId(name, taken) {
  for (let number = 1; ; number += 1) {
    const suffix = `-${number}`;
    const id = name.slice(0, LONGEST_ID - suffix.length) + suffix;
    if (!taken.has(id)) return id;
  }
}
