// A webcam: MediaPipe finds the landmarks of a hand in its pictures, in this page.
//
// MediaPipe's library and its model are beside the page where `pack.py --webcam` has put them.

const MODEL = "vision/hand_landmarker.task";

export class Webcam {
  /** @param say tells the person what to do. */
  constructor(say) {
    this.say = say;
    this.landmarks = null;
    this.isRunning = false;
  }

  async start() {
    this.isRunning = true;
    try {
      const vision = await import("./vision/vision_bundle.mjs");
      const files = await vision.FilesetResolver.forVisionTasks("vision/wasm");
      const options = { numHands: 1, runningMode: "VIDEO", baseOptions: { modelAssetPath: MODEL } };
      this.finder = await vision.HandLandmarker.createFromOptions(files, options);
      this.video = Object.assign(document.createElement("video"), { muted: true, playsInline: true });
      this.video.srcObject = await navigator.mediaDevices.getUserMedia({ video: { width: 640, height: 480 } });
      await this.video.play();
      this.say("Show your right hand, the palm to the camera.");
      this.look();
    } catch (error) {
      this.isRunning = false;
      this.say(`No webcam: ${error.message}. MediaPipe must be beside the page: python packages/handmap-js/pack.py FOLDER --webcam hand_landmarker.task.`);
    }
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
