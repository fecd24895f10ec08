// A study of two mappings: the same tasks with both, in random order and unlabelled, then the questions
// of NASA-TLX and the preference. The results are a file of `handmap study`; nothing is sent anywhere.

import { loadLibrary } from "./handmap.js";
import { DraggedHand, RecordingSource } from "./person.js";
import { shownAxes } from "./palm.js";
import { Scene, readShapes } from "./scene.js";
import { Webcam } from "./webcam.js";
import { Headset } from "./headset.js";

const RATE = 60; // of samples [1/s]
const MOST_STEPS = 60; // of a picture
const LIMIT = 60; // of a trial [s]
const HELD = 0.5; // time for which the ball is held [s]
const RADIUS = 0.012; // of the ball [m]
const REACH = 0.010; // between the ball and a tip that touches it: tips have pads [m]
const FINGERS = ["index", "middle"]; // that touch the ball with the thumb, a task each
const LABELS = ["A", "B"];
const SCALES = {
  mental: ["How mentally demanding was it?", "very low", "very high"],
  physical: ["How physically demanding was it?", "very low", "very high"],
  temporal: ["How hurried was the pace?", "very low", "very high"],
  performance: ["How successful were you?", "perfect", "failure"],
  effort: ["How hard did you have to work?", "very low", "very high"],
  frustration: ["How irritated or stressed were you?", "very low", "very high"],
};
const find = (id) => document.getElementById(id);

class Study {
  constructor() {
    this.scene = new Scene(find("canvas"));
    this.time = 0;
    this.started = performance.now();
    this.input = "drag";
    this.trial = null;
    this.results = { trials: [], workload: [] };
  }

  async load() {
    const [library, content, recording] = await Promise.all([
      loadLibrary("handmap.wasm"),
      fetch("hands.json").then((answer) => answer.json()),
      fetch("demo.bin").then((answer) => answer.arrayBuffer()),
    ]);
    Object.assign(this, { library, content, recording: new RecordingSource(recording) });
    this.about = content.hands.find((hand) => hand.mappings.length > 1);
    const { name, mappings } = this.about;
    const [shapes, ...saved] = await Promise.all(
      [`${name}.shapes`, `${name}.hand`, `${name}.${mappings[1]}.hand`].map((file) =>
        fetch(`hands/${file}`).then((answer) => answer.arrayBuffer())),
    );
    // A and B are the same mappings for everybody; their order is random.
    this.saved = { A: saved[0], B: saved[1] };
    this.order = Math.random() < 0.5 ? ["A", "B"] : ["B", "A"];
    this.use("A");
    this.scene.setRobot(readShapes(shapes), this.hand.linkNames);
    find("robot-name").textContent = this.about.title;
    this.balls = Object.fromEntries(FINGERS.map((finger) => [finger, this.ballFor(finger)]));
    this.listen();
    requestAnimationFrame((now) => this.frame(now));
  }

  /** Let the robot follow by a mapping from here on. */
  use(label) {
    this.hand?.free();
    this.hand = this.library.loadHand(this.saved[label]);
    this.dragged = new DraggedHand(this.hand, this.content.limits, this.content.rest);
    this.last = this.dragged.landmarks();
  }

  // -- the ball

  /** Where the robot's tips are [m], by finger. */
  tips() {
    const poses = this.hand.linkPoses();
    return Object.fromEntries(this.about.tips.map(({ name, link, xyz }) => {
      const at = 16 * this.hand.linkNames.indexOf(link);
      const row = (i) => poses.subarray(at + 4 * i, at + 4 * i + 4);
      return [name.split("_")[0], [0, 1, 2].map((i) => row(i)[0] * xyz[0] + row(i)[1] * xyz[1] + row(i)[2] * xyz[2] + row(i)[3])];
    }));
  }

  /** A place that thumb and finger reach, in axes of the palm as it is shown: where a recording brings both together. */
  ballFor(finger) {
    const hand = this.library.loadHand(this.saved.A);
    const own = this.hand;
    this.hand = hand;
    let best = null;
    let nearest = Infinity;
    for (let time = 0; time < this.recording.length; time += 1 / RATE) {
      const landmarks = this.recording.at(time);
      hand.mapLandmarks(landmarks, 1 / RATE);
      const { thumb, [finger]: tip } = this.tips();
      const distance = Math.hypot(...thumb.map((x, i) => x - tip[i]));
      if (distance >= nearest) continue;
      nearest = distance;
      best = toAxes(shownAxes(landmarks), thumb.map((x, i) => 0.5 * (x + tip[i])));
    }
    this.hand = own;
    hand.free();
    return best;
  }

  // -- trials

  begin() {
    Object.assign(this.results, {
      format: "handmap study",
      version: 1,
      participant: crypto.randomUUID(),
      started: new Date().toISOString(),
      consent: true,
      library: this.library.version,
      hand: this.about.name,
      input: this.input,
      mappings: Object.fromEntries(LABELS.map((label, i) => [label, { name: this.about.mappings[i], kind: "live" }])),
      order: this.order,
    });
    this.plan = this.order.flatMap((mapping) => FINGERS.map((finger) => ({ mapping, finger })));
    this.next();
  }

  next() {
    const { mapping, finger } = this.plan[0];
    if (finger === FINGERS[0]) this.use(mapping);
    const number = this.order.indexOf(mapping) + 1;
    find("task").textContent = `Mapping ${number} of 2: touch the ball with the robot's thumb and ${finger} finger, and hold it.`;
    find("clock").textContent = `${LIMIT} s`;
    show("trial");
    find("start").hidden = false;
    find("give-up").hidden = true;
  }

  startTrial() {
    this.trial = { ...this.plan[0], began: this.time, touchedSince: null, drops: 0 };
    find("start").hidden = true;
    find("give-up").hidden = false;
  }

  /** Look whether the ball is touched, after a sample. */
  watch() {
    const { trial } = this;
    const [x, y, z] = this.balls[trial.finger];
    const tips = this.tips();
    const isTouched = ["thumb", trial.finger].every((name) => {
      const at = toAxes(this.axes, tips[name]);
      return Math.hypot(at[0] - x, at[1] - y, at[2] - z) <= RADIUS + REACH;
    });
    if (isTouched) trial.touchedSince ??= this.time;
    else if (trial.touchedSince !== null) {
      trial.touchedSince = null;
      trial.drops += 1;
    }
    const seconds = this.time - trial.began;
    find("clock").textContent = `${Math.max(0, LIMIT - seconds).toFixed(0)} s`;
    if (trial.touchedSince !== null && this.time - trial.touchedSince >= HELD) this.endTrial(true, seconds);
    else if (seconds >= LIMIT) this.endTrial(false, LIMIT);
  }

  endTrial(isSuccess, seconds) {
    const { mapping, finger, drops } = this.trial;
    this.trial = null;
    this.results.trials.push({
      mapping, task: `touch with thumb and ${finger}`, number: 0, limit: LIMIT,
      seconds: Math.min(seconds, LIMIT), is_success: isSuccess, drops,
    });
    this.plan.shift();
    if (this.plan[0]?.mapping === mapping) this.next();
    else this.ask(mapping);
  }

  // -- questions

  ask(mapping) {
    this.asked = mapping;
    find("scales").replaceChildren(...Object.entries(SCALES).map(([name, [question, low, high]]) => {
      const label = Object.assign(document.createElement("label"), { textContent: question });
      const slider = Object.assign(document.createElement("input"), { type: "range", min: 0, max: 100, step: 5, value: 50, name });
      const ends = Object.assign(document.createElement("span"), { className: "small", textContent: ` ${low} – ${high}` });
      label.append(slider, ends);
      return label;
    }));
    show("questions");
  }

  answer() {
    const answers = Object.fromEntries([...find("scales").querySelectorAll("input")].map(({ name, value }) => [name, Number(value)]));
    this.results.workload.push({ mapping: this.asked, ...answers });
    if (this.plan.length > 0) this.next();
    else show("choice");
  }

  finish(choice) {
    const { order } = this.results;
    this.results.preference = { first: order[0], second: order[1], none: "none" }[choice];
    const text = JSON.stringify(this.results, null, 1);
    Object.assign(find("file"), {
      href: URL.createObjectURL(new Blob([text], { type: "application/json" })),
      download: `study-${this.results.participant.slice(0, 8)}.json`,
    });
    show("end");
  }

  // -- samples and pictures

  landmarksAt(seconds) {
    if (this.input === "drag") return this.dragged.step();
    if (this.input === "recording") return this.recording.at(seconds);
    return this.source?.landmarks ?? null;
  }

  frame(now) {
    requestAnimationFrame((next) => this.frame(next));
    const seconds = (now - this.started) / 1e3;
    const isLive = this.input === "webcam" || this.input === "headset";
    const steps = isLive ? 1 : Math.min(Math.max(Math.round((seconds - this.time) * RATE), 1), MOST_STEPS);
    for (let i = steps - 1; i >= 0; i -= 1) this.step(isLive ? seconds : seconds - i / RATE);
    const ball = this.plan?.length ? this.balls[this.plan[0].finger] : null;
    this.scene.place(this.last, this.hand.linkPoses(), this.axes);
    this.scene.placeBall(ball, RADIUS);
    this.scene.render();
  }

  step(seconds) {
    const seen = this.landmarksAt(seconds);
    if (seen) this.last = seen;
    this.axes = shownAxes(this.last);
    this.hand.follow({ time: seconds, landmarks: this.last, valid: Boolean(seen) });
    this.time = seconds;
    if (this.trial) this.watch();
  }

  // -- what the person does

  listen() {
    find("agree").addEventListener("change", () => { find("begin").disabled = !find("agree").checked; });
    find("begin").addEventListener("click", async () => {
      this.input = find("input").value;
      const say = (text) => { find("input-state").textContent = text; };
      if (this.input === "webcam") this.source = new Webcam(say);
      if (this.input === "headset") this.source = new Headset(say, this.hand.side);
      await this.source?.start();
      find("hint").textContent = this.input === "drag" ? "Drag fingertips of your hand, on the left." : "";
      this.begin();
    });
    find("start").addEventListener("click", () => this.startTrial());
    find("give-up").addEventListener("click", () => this.endTrial(false, this.time - this.trial.began));
    find("answer").addEventListener("click", () => this.answer());
    for (const button of document.querySelectorAll("[data-choice]")) {
      button.addEventListener("click", () => this.finish(button.dataset.choice));
    }
    this.scene.listenToPointer(() => (this.input === "drag" ? this.dragged : null), () => this.axes);
  }
}

/** A point in axes of 16 numbers, row by row. */
function toAxes(axes, [x, y, z]) {
  return [0, 4, 8].map((row) => axes[row] * x + axes[row + 1] * y + axes[row + 2] * z + axes[row + 3]);
}

/** Show one of the sections. */
function show(id) {
  for (const section of document.querySelectorAll("section")) section.hidden = section.id !== id;
}

const study = new Study();
window.study = study; // for tests
study.load().catch((error) => {
  find("hint").textContent = `The page cannot start: ${error.message}`;
});
