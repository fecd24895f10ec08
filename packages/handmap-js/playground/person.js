// The person's hand: a recording, or a hand of joint angles whose fingertips are dragged.

const COORDINATES = 63;
const STEP = 1e-4; // of an angle, for differences [rad]
const DAMPING = 0.004; // of a step to a dragged place [m]
const TIP_OF = { 4: 0, 8: 1, 12: 2, 16: 3, 20: 4 };
const JOINTS = 4; // of a finger
export const UPRIGHT = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** Samples one after the other, there and back again, so that the hand never jumps. */
export class RecordingSource {
  constructor(buffer) {
    this.rows = new Float32Array(buffer);
    this.width = 1 + COORDINATES;
    this.count = this.rows.length / this.width;
    this.length = this.rows[(this.count - 1) * this.width];
    this.next = 0;
  }

  /** Landmarks at a time since the start [s]. */
  at(time) {
    let within = time % (2 * this.length);
    if (within > this.length) within = 2 * this.length - within;
    let low = 0;
    let high = this.count - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.rows[middle * this.width] <= within) low = middle;
      else high = middle;
    }
    const from = this.rows.subarray(low * this.width, (low + 1) * this.width);
    const to = this.rows.subarray(high * this.width, (high + 1) * this.width);
    const share = high > low ? (within - from[0]) / (to[0] - from[0]) : 0;
    return Float64Array.from({ length: COORDINATES }, (_, i) => from[1 + i] + share * (to[1 + i] - from[1 + i]));
  }
}

/** A hand whose fingertips are dragged: each finger's angles follow by damped least squares. */
export class DraggedHand {
  /** @param hand whose person it is. @param limits of the person's joints, and its posture at rest [rad]. */
  constructor(hand, { lower, upper }, rest) {
    this.hand = hand;
    this.lower = lower;
    this.upper = upper;
    this.q = Float64Array.from(rest);
    this.goal = null;
  }

  landmarks(q = this.q) {
    return this.hand.humanLandmarks(q, UPRIGHT);
  }

  /** Drag a fingertip, a landmark's number, towards a place in the person's world [m]. */
  drag(tip, place) {
    this.goal = place && { tip, place };
  }

  /** Move nearer to the place, and return the landmarks. */
  step() {
    if (this.goal) for (let i = 0; i < 3; i += 1) this.approach(this.goal);
    return this.landmarks();
  }

  approach({ tip, place }) {
    const first = JOINTS * TIP_OF[tip];
    const at = this.landmarks().slice(3 * tip, 3 * tip + 3);
    const columns = [];
    for (let j = first; j < first + JOINTS; j += 1) {
      const moved = Float64Array.from(this.q);
      moved[j] += STEP;
      const there = this.landmarks(moved).slice(3 * tip, 3 * tip + 3);
      columns.push(there.map((x, i) => (x - at[i]) / STEP));
    }
    const error = place.map((x, i) => x - at[i]);
    const step = leastSquares(columns, error);
    for (let k = 0; k < JOINTS; k += 1) {
      const j = first + k;
      this.q[j] = Math.min(Math.max(this.q[j] + step[k], this.lower[j]), this.upper[j]);
    }
  }
}

/** Solve (J J^T + d^2 I) y = e for three unknowns; return J^T y. */
function leastSquares(columns, error) {
  const a = [0, 1, 2].map((i) => [0, 1, 2].map((j) => columns.reduce((sum, c) => sum + c[i] * c[j], i === j ? DAMPING ** 2 : 0)));
  const y = solve3(a, error);
  return columns.map((c) => c[0] * y[0] + c[1] * y[1] + c[2] * y[2]);
}

/** Solve three equations by Cramer's rule. */
function solve3(a, b) {
  const determinant = (m) =>
    m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) -
    m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0]) +
    m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
  const whole = determinant(a);
  return [0, 1, 2].map((k) => determinant(a.map((row, i) => row.map((x, j) => (j === k ? b[i] : x)))) / whole);
}
