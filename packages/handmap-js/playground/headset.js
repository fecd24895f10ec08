// A headset: its hand tracking leads the robot, by WebXR.

// Joints of WebXR that are the landmarks, in MediaPipe's order: those at the ends of metacarpals are not.
const JOINTS = [
  "wrist",
  ...["metacarpal", "phalanx-proximal", "phalanx-distal", "tip"].map((part) => `thumb-${part}`),
  ...["index", "middle", "ring", "pinky"].flatMap((finger) =>
    ["proximal", "intermediate", "distal"].map((part) => `${finger}-finger-phalanx-${part}`).concat(`${finger}-finger-tip`)),
];

export class Headset {
  /** @param say tells the person what to do. @param side of the hand that leads. */
  constructor(say, side) {
    this.say = say;
    this.side = side;
    this.landmarks = null;
  }

  async start() {
    if (!navigator.xr) {
      this.say("This browser has no WebXR. Open this page in the browser of a headset, over https.");
      return;
    }
    try {
      this.session = await navigator.xr.requestSession("immersive-vr", { requiredFeatures: ["hand-tracking"] });
      this.space = await this.session.requestReferenceSpace("local");
      this.session.addEventListener("end", () => { this.landmarks = null; });
      this.session.requestAnimationFrame((time, frame) => this.step(frame));
      this.say(`Move your ${this.side} hand.`);
    } catch (error) {
      this.say(`No headset: ${error.message}`);
    }
  }

  step(frame) {
    frame.session.requestAnimationFrame((time, next) => this.step(next));
    this.landmarks = null;
    for (const source of frame.session.inputSources) {
      if (source.hand && source.handedness === this.side) this.landmarks = this.read(frame, source.hand);
    }
  }

  read(frame, hand) {
    const numbers = [];
    for (const name of JOINTS) {
      const pose = frame.getJointPose(hand.get(name), this.space);
      if (!pose) return null;
      const { x, y, z } = pose.transform.position;
      numbers.push(x, y, z);
    }
    return Float64Array.from(numbers);
  }

  stop() {
    this.session?.end().catch(() => {});
  }
}
