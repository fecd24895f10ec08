// How a hand is shown: the middle of its palm at the origin, its fingers up, its palm to the viewer.

const WRIST = 0;
const MIDDLE = 9;
const INDEX = 5;
const LITTLE = 17;

const minus = (a, b) => a.map((x, i) => x - b[i]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const unit = (a) => a.map((x) => x / Math.hypot(...a));

/** The world of 21 landmarks as it is shown, 16 numbers, row by row. */
export function shownAxes(landmarks) {
  const at = (i) => Array.from(landmarks.subarray(3 * i, 3 * i + 3));
  const up = unit(minus(at(MIDDLE), at(WRIST)));
  const across = minus(at(INDEX), at(LITTLE));
  const side = unit(minus(across, up.map((x) => x * dot(across, up))));
  const front = cross(side, up);
  const middle = at(WRIST).map((x, i) => 0.5 * (x + at(MIDDLE)[i]));
  return [side, up, front].flatMap((row) => [...row, -dot(row, middle)]).concat([0, 0, 0, 1]);
}
