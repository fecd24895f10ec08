// A headset in a browser that has none: navigator.xr with hand tracking, as far as the page needs
// it. `emulated` controls it: `hands` holds positions of 25 joints by side, `controllers` further
// input sources, `rate` is in Hz; `session` is the session, which the system can end.
// Its clock counts frames, so that hands which `beforeFrame` moves keep their speed on a busy machine.
"use strict";
const SIZE = [480, 270]; // of the picture that the headset shows [px]
const DRAWN = 5; // one of so many frames has a viewer, for whom the page draws in software

// On a busy machine the clock is slower than the service's, which takes such stamps for those of
// another unit, and frames come seldom, for which its watchdog does not wait. So the clock is that of
// a simulation, and the service waits as long as it can.
const SIMULATION = { time_from: "client", watchdog: 10 };
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function sendSimulated(text) {
  const request = JSON.parse(text);
  const more = request.type === "open" ? SIMULATION : {};
  send.call(this, JSON.stringify({ ...more, ...request }));
};
window.emulated = { hands: {}, controllers: [], rate: 72, isSupported: true, hasHands: true, frames: 0, requests: [] };

class EmulatedLayer {
  constructor(session, gl) {
    this.gl = gl;
    this.framebuffer = null;
    [gl.canvas.width, gl.canvas.height] = SIZE;
    emulated.gl = gl;
  }

  getViewport() {
    return { x: 0, y: 0, width: SIZE[0], height: SIZE[1] };
  }
}

class EmulatedFrame {
  constructor(session) {
    this.session = session;
    this.isActive = true;
    this.isDrawn = emulated.frames % DRAWN === 0;
  }

  getJointPose({ side, index }) {
    if (!this.isActive) throw new DOMException("the frame is over", "InvalidStateError");
    const joint = emulated.hands[side]?.[index];
    return joint && { transform: { position: { x: joint[0], y: joint[1], z: joint[2] } } };
  }

  getViewerPose() {
    if (!this.isDrawn) return null;
    const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    const view = emulated.eye ?? [0, 0, 0];
    const matrix = [...identity];
    const inverse = [...identity];
    for (const axis of [0, 1, 2]) {
      matrix[12 + axis] = view[axis];
      inverse[12 + axis] = -view[axis];
    }
    const scale = 1.2;
    const projectionMatrix = new Float32Array(
      [(scale * SIZE[1]) / SIZE[0], 0, 0, 0, 0, scale, 0, 0, 0, 0, -1, -1, 0, 0, -0.02, 0],
    );
    const transform = { matrix, inverse: { matrix: new Float32Array(inverse) } };
    return { transform, views: [{ projectionMatrix, transform }] };
  }
}

class EmulatedSession extends EventTarget {
  constructor(mode) {
    super();
    this.environmentBlendMode = mode === "immersive-ar" ? "alpha-blend" : "opaque";
    this.renderState = {};
    this.callbacks = [];
    this.isOver = false;
    let now = performance.now();
    const tick = () => {
      if (this.isOver) return;
      setTimeout(tick, 1000 / emulated.rate);
      now += 1000 / emulated.rate;
      emulated.beforeFrame?.();
      const frame = new EmulatedFrame(this);
      for (const callback of this.callbacks.splice(0)) callback(now, frame);
      frame.isActive = false;
      emulated.frames += 1;
      if (!frame.isDrawn) return;
      emulated.afterFrame?.();
      emulated.afterFrame = null;
    };
    setTimeout(tick);
  }

  get inputSources() {
    const hands = Object.keys(emulated.hands).map((side) => ({
      handedness: side,
      hand: new Map(Array.from({ length: 25 }, (_, index) => [`joint-${index}`, { side, index }])),
    }));
    return [...hands, ...emulated.controllers];
  }

  updateRenderState(state) {
    Object.assign(this.renderState, state);
  }

  async requestReferenceSpace(kind) {
    if (kind === "local-floor") throw new DOMException("not offered", "NotSupportedError");
    return { kind };
  }

  requestAnimationFrame(callback) {
    this.callbacks.push(callback);
  }

  async end() {
    this.isOver = true;
    this.dispatchEvent(new Event("end"));
  }
}

window.XRWebGLLayer = EmulatedLayer;
Object.defineProperty(navigator, "xr", {
  value: {
    async isSessionSupported(mode) {
      return emulated.isSupported && mode === "immersive-vr";
    },
    async requestSession(mode, wanted) {
      emulated.requests.push({ mode, wanted });
      if (!navigator.userActivation.isActive) throw new DOMException("no click", "SecurityError");
      if (!emulated.hasHands) throw new DOMException("no hands", "NotSupportedError");
      emulated.session = new EmulatedSession(mode);
      return emulated.session;
    },
  },
});
