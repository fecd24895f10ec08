// The emergency stop in a headset: a red disc above the eyes that a fingertip touches, and the upper
// button of a controller, B or Y.

// The disc moves with the head, so that it is always in reach. It is above the eyes, where hands that
// lead a robot seldom are; a touch by mistake only stops.
const PLACE = { up: 0.22, ahead: 0.38 }; // of its centre, from the eyes, level [m]
const RADIUS = 0.06; // of the disc, and of the space around its centre that counts as touched [m]
const TOUCH = 100; // time after which a touch counts [ms]: a hand may be tracked wrongly for a frame
const TIPS = [4, 9, 14, 19, 24]; // joints of WebXR at the ends of the fingers
const UPPER = 5; // B or Y, in the mapping xr-standard of WebXR's gamepads

export class StopButton {
  constructor() {
    this.radius = RADIUS;
    this.reset();
  }

  /** Forget the last session. */
  reset() {
    this.middle = null; // of the disc [m]; null before the viewer was seen
    this.right = null; // horizontal direction along the disc, (x, z)
    this.touchedAt = null; // time of the first frame of a touch [ms]
    this.wasPressed = false;
  }

  /** Move the disc with the viewer, a matrix of 16 numbers. */
  follow(viewer) {
    const [sideX, sideZ] = [viewer[0], viewer[2]];
    const norm = Math.hypot(sideX, sideZ);
    if (norm < 1e-3) return; // the head lies on its side: ahead is not known
    this.right = [sideX / norm, sideZ / norm];
    this.middle = [
      viewer[12] + this.right[1] * PLACE.ahead, viewer[13] + PLACE.up,
      viewer[14] - this.right[0] * PLACE.ahead,
    ];
  }

  /**
   * Whether the stop was pressed in this frame: once for each touch and for each press.
   *
   * @param time time stamp of the frame [ms]
   * @param hands joint positions by side [m]; null for a hand that is not tracked
   * @param sources input sources of the session
   */
  isPressed(time, hands, sources) {
    const isTouched = Object.values(hands).some((joints) => joints && this.isTouchedBy(joints));
    if (!isTouched) this.touchedAt = null;
    else this.touchedAt ??= time;
    const isHeld = isTouched && time - this.touchedAt >= TOUCH;
    const isPressed = isHeld
      || Array.from(sources).some(({ gamepad }) => gamepad?.buttons[UPPER]?.pressed);
    const isNew = isPressed && !this.wasPressed;
    this.wasPressed = isPressed;
    return isNew;
  }

  isTouchedBy(joints) {
    if (!this.middle) return false;
    return TIPS.some((tip) => Math.hypot(...joints[tip].map((x, i) => x - this.middle[i])) < RADIUS);
  }
}
