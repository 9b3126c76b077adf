// Vectors of three numbers and matrices of four columns, as plain arrays.

export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => scale(a, 1 / (norm(a) || 1));
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
/** Row i of an array of rows of three. */
export const row = (array, i) => [array[3 * i], array[3 * i + 1], array[3 * i + 2]];

/** A unit vector across another. */
export function across(a) {
  const least = a.map(Math.abs).indexOf(Math.min(...a.map(Math.abs)));
  return unit(cross(a, [0, 1, 2].map((i) => Number(i === least))));
}

/** Product of two matrices, by columns. */
export function multiply(a, b) {
  const product = new Float32Array(16);
  for (let j = 0; j < 4; j++) {
    for (let i = 0; i < 4; i++) {
      for (let k = 0; k < 4; k++) product[4 * j + i] += a[4 * k + i] * b[4 * j + k];
    }
  }
  return product;
}

/** Matrix that takes the z axis to `axis`, times `width` across and `length` along, to `at`. */
export function placing(at, axis, width, length) {
  const x = across(axis), y = cross(axis, x);
  return new Float32Array([
    ...scale(x, width), 0, ...scale(y, width), 0, ...scale(axis, length), 0, ...at, 1,
  ]);
}
