// JSON merge patches (RFC 7396) from single changed values.

/**
 * @param {Map<string, unknown>} changes JSON pointer, at most two levels deep → new value, in the order they were made
 * @param {object} object as the service has it: a merge patch holds an array whole, so its other elements come from here
 */
export function mergePatch(changes, object) {
  const patch = {};
  for (const [pointer, value] of changes) {
    const [member, part] = pointer.slice(1).split('/');
    if (part === undefined) {
      patch[member] = value;
    } else if (Array.isArray(object[member])) {
      patch[member] ??= [...object[member]];
      patch[member][part] = value;
    } else {
      patch[member] = { ...patch[member], [part]: value };
    }
  }
  return patch;
}
