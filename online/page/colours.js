// Colours of values: viridis, whose lightness rises evenly, so that colour-blind people read it.

const STOPS = [
  [68, 1, 84], [72, 36, 117], [65, 68, 135], [53, 95, 141], [42, 120, 142], [33, 145, 140],
  [34, 168, 132], [68, 191, 112], [122, 209, 81], [189, 223, 38], [253, 231, 37],
];

/** Colour of a value from 0 to 1, as three numbers from 0 to 255. */
export function colourOf(value) {
  const at = Math.min(Math.max(value, 0), 1) * (STOPS.length - 1);
  const i = Math.min(Math.floor(at), STOPS.length - 2);
  return STOPS[i].map((c, axis) => Math.round(c + (at - i) * (STOPS[i + 1][axis] - c)));
}

/** The colours from 0 to 1, four bytes each. */
export const TABLE = Uint8Array.from(
  Array.from({ length: 256 }, (_, i) => [...colourOf(i / 255), 255]).flat(),
);

/** A round number, 1, 2 or 5 times a power of ten, that is no less than a value. */
export function roundUp(value) {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].find((m) => m * power >= value * (1 - 1e-9)) * power;
}
