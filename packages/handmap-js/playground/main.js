// The playground: a person's hand leads a robot's, by the library that runs on robots.

import { loadLibrary } from "./handmap.js";
import { DraggedHand, RecordingSource } from "./person.js";
import { shownAxes } from "./palm.js";
import { Scene, readShapes } from "./scene.js";
import { Webcam } from "./webcam.js";
import { Headset } from "./headset.js";

const LOSS = 0.5; // [s]
const RATE = 60; // of samples that the page makes [1/s]
const MOST_STEPS = 60; // of a picture: a page that was hidden does not make up for all of it
const NOWHERE = new Float64Array(63);
const find = (id) => document.getElementById(id);

class Playground {
  constructor() {
    this.scene = new Scene(find("canvas"));
    this.input = "recording";
    this.started = performance.now();
    this.time = 0; // of the last sample, since the start [s]
    this.lostUntil = 0;
    this.frames = [];
  }

  async load() {
    const [library, content, recording] = await Promise.all([
      loadLibrary("handmap.wasm"),
      fetch("hands.json").then((answer) => answer.json()),
      fetch("demo.bin").then((answer) => answer.arrayBuffer()),
    ]);
    this.library = library;
    this.content = content;
    this.recording = new RecordingSource(recording);
    for (const { name, title, joints } of content.hands) {
      find("hands").append(new Option(`${title} (${joints} joints)`, name));
    }
    const wanted = new URLSearchParams(location.search).get("hand");
    if (content.hands.some(({ name }) => name === wanted)) find("hands").value = wanted;
    this.listen();
    await this.choose(find("hands").value);
    this.listLicences();
    requestAnimationFrame((now) => this.frame(now));
  }

  // -- the robot

  async choose(name) {
    const [saved, shapes] = await Promise.all(
      [`hands/${name}.hand`, `hands/${name}.shapes`].map((file) => fetch(file).then((answer) => answer.arrayBuffer())),
    );
    this.saved = saved;
    this.about = this.content.hands.find((hand) => hand.name === name);
    this.build();
    this.scene.setRobot(readShapes(shapes), this.hand.linkNames);
    find("robot-name").textContent = this.about.title;
    find("joints").replaceChildren(...this.hand.jointNames.map((joint, j) => {
      const meter = Object.assign(document.createElement("meter"), { min: this.limits.lower[j], max: this.limits.upper[j], title: joint });
      return meter;
    }));
  }

  /** Make the hand again, with the options of the page. */
  build() {
    this.hand?.free();
    this.hand = this.library.loadHand(this.saved, { rejoin: find("rejoin").value, smoothing: this.smoothing() });
    this.limits = this.hand.jointLimits();
    const { limits, rest } = this.content;
    const q = this.dragged?.q ?? rest;
    this.dragged = new DraggedHand(this.hand, limits, q);
  }

  smoothing() {
    // At 0 none; at .7 the acceleration of the library; at 1 a tenth of it.
    const share = Number(find("smoothing").value);
    return share === 0 ? null : { acceleration: 0.4 * 10 ** ((0.7 - share) / 0.3), speedGain: 12 };
  }

  // -- the person

  /** Landmarks of the person at a time [s], or null where the hand is not seen. */
  landmarksAt(seconds) {
    if (this.input === "drag") return this.dragged.step();
    if (this.input === "webcam") return this.webcam?.landmarks ?? null;
    if (this.input === "headset") return this.headset?.landmarks ?? null;
    return this.recording.at(seconds);
  }

  frame(now) {
    requestAnimationFrame((next) => this.frame(next));
    const seconds = (now - this.started) / 1e3;
    // Where pictures are slow, the hand is led as often all the same: a tracker has its own rate.
    const isLive = this.input === "webcam" || this.input === "headset";
    const steps = isLive ? 1 : Math.min(Math.max(Math.round((seconds - this.time) * RATE), 1), MOST_STEPS);
    const began = performance.now();
    let command;
    for (let i = steps - 1; i >= 0; i -= 1) command = this.step(isLive ? seconds : seconds - i / RATE);
    const took = (performance.now() - began) / steps;
    this.time = seconds;
    if (this.last) {
      this.axes = shownAxes(this.last);
      this.scene.place(this.last, this.hand.linkPoses(), this.axes);
    }
    this.scene.render();
    this.tell(command, took, now);
  }

  /** Let the robot follow the person's hand at a time [s]; return its command. */
  step(seconds) {
    const seen = this.landmarksAt(seconds);
    const size = Number(find("size").value);
    const landmarks = seen?.map((x) => size * x);
    const isSeen = Boolean(landmarks) && seconds >= this.lostUntil;
    if (landmarks) this.last = landmarks;
    return this.hand.follow({ time: seconds, landmarks: landmarks ?? this.last ?? NOWHERE, valid: isSeen });
  }

  // -- what the page says

  tell(command, took, now) {
    this.frames = [...this.frames.filter((each) => now - each.now < 1000), { now, took }];
    if (now - (this.toldAt ?? 0) < 200) return;
    this.toldAt = now;
    const mapping = this.frames.reduce((sum, each) => sum + each.took, 0) / this.frames.length;
    const rows = {
      Robot: command.isHeld ? "held" : command.isGliding ? "gliding back" : command.status,
      Sample: command.rule || "fine",
      Mapping: `${mapping.toFixed(2)} ms a sample`,
      Pictures: `${this.frames.length} a second`,
    };
    find("state").replaceChildren(...Object.entries(rows).flatMap(([name, text]) => [
      Object.assign(document.createElement("dt"), { textContent: name }),
      Object.assign(document.createElement("dd"), { textContent: text }),
    ]));
    [...find("joints").children].forEach((meter, j) => {
      meter.value = command.q[j];
      const room = Math.min(command.q[j] - meter.min, meter.max - command.q[j]);
      meter.classList.toggle("at-limit", room < 1e-3);
    });
    document.body.dataset.frames = this.frames.length;
    document.body.dataset.held = command.isHeld;
    document.body.dataset.q = JSON.stringify([...command.q]);
  }

  listLicences() {
    find("licences").addEventListener("click", (event) => {
      event.preventDefault();
      find("licence-list").hidden = !find("licence-list").hidden;
    });
    find("licence-list").replaceChildren(...this.content.hands.map(({ title, source, licence }) =>
      Object.assign(document.createElement("p"), { textContent: `${title}: of ${source}${licence ? `, ${licence}` : ""}` })));
  }

  // -- what the person does

  listen() {
    find("hands").addEventListener("change", () => this.choose(find("hands").value));
    for (const option of [find("rejoin"), find("smoothing")]) option.addEventListener("change", () => this.build());
    for (const slider of document.querySelectorAll(".slider input")) {
      const say = () => { slider.nextElementSibling.value = Number(slider.value).toFixed(2); };
      slider.addEventListener("input", say);
      say();
    }
    for (const radio of document.querySelectorAll("input[name=input]")) {
      radio.addEventListener("change", () => this.lead(radio.value));
    }
    find("stop").addEventListener("click", () => this.hand.stop(this.hand.dt));
    find("engage").addEventListener("click", () => this.hand.engage());
    find("lose").addEventListener("click", () => {
      this.lostUntil = (performance.now() - this.started) / 1e3 + LOSS;
    });
    this.scene.listenToPointer(() => (this.input === "drag" ? this.dragged : null), () => this.axes);
  }

  /** Lead the robot by another input, from here on: its first sample is the reference. */
  async lead(input) {
    this.webcam?.stop();
    this.headset?.stop();
    this.webcam = null;
    this.headset = null;
    this.input = input;
    find("hint").textContent = input === "drag" ? "Drag a fingertip of your hand, on the left." : "";
    const say = (text) => { find("input-state").textContent = text; };
    say("");
    if (input === "webcam") {
      this.webcam = new Webcam(say);
      await this.webcam.start();
    }
    if (input === "headset") {
      this.headset = new Headset(say, this.hand.side);
      await this.headset.start();
    }
    this.hand.engage();
  }
}

navigator.serviceWorker?.register("offline.js").catch(() => {}); // the page works without it, too

const page = new Playground();
window.playground = page; // for the console, and for tests
page.load().catch((error) => {
  find("hint").textContent = `The page cannot start: ${error.message}`;
});
