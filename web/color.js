// Between the linear factors of a material and the sRGB of `<input type="color">`.

/** @param {number} value 0 to 1, sRGB coded */
export const linearFromSrgb = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);

/** @param {number} value 0 to 1, linear */
export const srgbFromLinear = (value) => (value <= 0.0031308 ? value * 12.92 : 1.055 * value ** (1 / 2.4) - 0.055);

/** @returns {number[]} linear red, green, blue, 0 to 1, with no more digits than 8 bits carry */
export function linearFromHex(hex) {
  const codes = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
  return codes.map((code) => Math.round(linearFromSrgb(code / 255) * 1e5) / 1e5);
}

/** @param {number[]} color linear red, green, blue; clipped to 0 to 1 */
export function hexFromLinear(color) {
  const codes = color.map((value) => Math.round(255 * srgbFromLinear(Math.min(1, Math.max(0, value)))));
  return `#${codes.map((code) => code.toString(16).padStart(2, '0')).join('')}`;
}
