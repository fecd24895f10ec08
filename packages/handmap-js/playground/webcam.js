// A webcam: MediaPipe finds the landmarks of a hand in its pictures, in this page.
//
// MediaPipe's library is beside the page where `pack.py --webcam` has put it; its model is there, too, or
// the person gives its file.

const MODEL = "vision/hand_landmarker.task";

export class Webcam {
  /** @param say tells the person what to do. @param file where the person gives the model. */
  constructor(say, file) {
    this.say = say;
    this.file = file;
    this.landmarks = null;
    this.isRunning = false;
  }

  async start() {
    this.isRunning = true;
    try {
      const vision = await import("./vision/vision_bundle.mjs");
      const files = await vision.FilesetResolver.forVisionTasks("vision/wasm");
      const options = { numHands: 1, runningMode: "VIDEO", baseOptions: await this.model() };
      this.finder = await vision.HandLandmarker.createFromOptions(files, options);
      this.video = Object.assign(document.createElement("video"), { muted: true, playsInline: true });
      this.video.srcObject = await navigator.mediaDevices.getUserMedia({ video: { width: 640, height: 480 } });
      await this.video.play();
      this.say("Show your right hand, the palm to the camera.");
      this.look();
    } catch (error) {
      this.isRunning = false;
      this.say(`No webcam: ${error.message}. The page needs MediaPipe beside it: python packages/handmap-js/pack.py --webcam.`);
    }
  }

  /** The model that is beside the page, or the one that the person gives. */
  async model() {
    const answer = await fetch(MODEL, { method: "HEAD" }).catch(() => null);
    if (answer?.ok) return { modelAssetPath: MODEL };
    this.say("Give the file hand_landmarker.task of MediaPipe.");
    const given = await new Promise((resolve) => {
      this.file.addEventListener("change", () => resolve(this.file.files[0]), { once: true });
    });
    return { modelAssetBuffer: new Uint8Array(await given.arrayBuffer()) };
  }

  look() {
    if (!this.isRunning) return;
    const found = this.finder.detectForVideo(this.video, performance.now());
    const [points] = found.worldLandmarks;
    // MediaPipe's y points down, and its z away from the camera.
    this.landmarks = points ? Float64Array.from(points.flatMap(({ x, y, z }) => [x, -y, -z])) : null;
    this.video.requestVideoFrameCallback(() => this.look());
  }

  stop() {
    this.isRunning = false;
    for (const track of this.video?.srcObject?.getTracks() ?? []) track.stop();
  }
}
