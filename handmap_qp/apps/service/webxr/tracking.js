// The hands of a headset: an immersive session of WebXR with hand tracking, and its emergency stop.

import { StopButton } from "./stop_button.js";

/** Positions of a hand's joints in the order of WebXR [m], or null if one is not tracked. */
function jointPositions(frame, hand, space) {
  const positions = [];
  for (const joint of hand.values()) {
    const pose = frame.getJointPose(joint, space);
    if (!pose) return null;
    const { x, y, z } = pose.transform.position;
    positions.push([x, y, z]);
  }
  return positions;
}

export class Tracking extends EventTarget {
  constructor(scene) {
    super();
    this.scene = scene; // draws in the headset
    this.session = null;
    this.stopButton = new StopButton();
  }

  /** Which of immersive-vr and immersive-ar this browser offers. */
  static async modes() {
    const modes = { vr: false, ar: false };
    for (const mode of navigator.xr ? ["vr", "ar"] : []) {
      modes[mode] = await navigator.xr.isSessionSupported(`immersive-${mode}`).catch(() => false);
    }
    return modes;
  }

  async start(mode) {
    const session = await navigator.xr.requestSession(`immersive-${mode}`, {
      requiredFeatures: ["hand-tracking"], optionalFeatures: ["local-floor"],
    });
    try {
      this.scene.prepare(session);
      this.space = await session.requestReferenceSpace("local-floor")
        .catch(() => session.requestReferenceSpace("local"));
    } catch (error) {
      await session.end();
      throw error;
    }
    this.session = session;
    this.stopButton.reset();
    session.addEventListener("end", () => {
      this.session = null;
      this.dispatchEvent(new Event("end"));
    });
    session.requestAnimationFrame((time, frame) => this.step(time, frame));
  }

  stop() {
    this.session?.end();
  }

  step(time, frame) {
    const { session } = frame;
    if (session !== this.session) return;
    session.requestAnimationFrame((next, nextFrame) => this.step(next, nextFrame));
    const hands = {};
    for (const source of session.inputSources) {
      if (source.hand) hands[source.handedness] = jointPositions(frame, source.hand, this.space);
    }
    const pose = frame.getViewerPose(this.space);
    if (pose) this.stopButton.follow(pose.transform.matrix);
    // Events are dispatched at once, so the frame is still active.
    if (this.stopButton.isPressed(time, hands, session.inputSources)) {
      this.dispatchEvent(new Event("stop"));
    }
    this.dispatchEvent(new CustomEvent("frame", { detail: { time, hands } }));
    this.scene.draw(frame, pose, hands, this.stopButton);
  }
}
