// Follows the samples of a file by the library in WebAssembly, and prints what came of each:
//
//     node follow.mjs handmap.js handmap.wasm FILE.hand SAMPLES.json
import fs from "node:fs";
import { pathToFileURL } from "node:url";

const [library, wasm, saved, samples] = process.argv.slice(2);
const { HandmapError, loadLibrary } = await import(pathToFileURL(library));
const { loadHand, version } = await loadLibrary(fs.readFileSync(wasm)).then((found) => ({
  loadHand: (...given) => found.loadHand(...given),
  version: found.version,
}));

const hand = loadHand(fs.readFileSync(saved));
const commands = [];
const times = [];
for (const sample of JSON.parse(fs.readFileSync(samples, "utf8"))) {
  const began = performance.now();
  const command = hand.follow(sample);
  times.push(performance.now() - began);
  commands.push({ ...command, q: [...command.q], wrist: [...command.wrist], velocity: [...command.velocity] });
}

// What is wrong is said, and changes nothing.
const before = [...hand.hold(hand.dt).q];
const landmarks = new Float64Array(63);
const refused = {};
for (const [name, call] of Object.entries({
  "few landmarks": () => hand.follow({ time: 0, landmarks: [1, 2, 3] }),
  "no landmarks": () => hand.follow({ time: 0 }),
  "hole": () => hand.mapLandmarks(landmarks.map(() => NaN), hand.dt),
  "no time": () => hand.mapLandmarks(landmarks, 0),
  "wrist": () => hand.mapLandmarks(landmarks, hand.dt, new Float64Array(16)),
  "joints": () => hand.mapJoints([1], new Float64Array(16), hand.dt),
  "bytes": () => loadHand(new Uint8Array(7)),
  "rejoin": () => loadHand(fs.readFileSync(saved), { rejoin: "jump" }),
  "smoothing": () => loadHand(fs.readFileSync(saved), { smoothing: { acceleration: -1, speedGain: 0 } }),
})) {
  try {
    call();
  } catch (error) {
    refused[name] = error instanceof HandmapError ? [error.kind, error.message] : ["other", String(error)];
  }
}
const after = [...hand.hold(hand.dt).q];
// Hands that come and go leave no memory behind.
const pages = [];
for (let i = 0; i < 40; i += 1) {
  loadHand(fs.readFileSync(saved)).free();
  pages.push(hand.library.c.memory.buffer.byteLength);
}
console.log(JSON.stringify({
  version, name: hand.name, side: hand.side, joints: hand.jointNames, links: hand.linkNames.length,
  limits: Object.fromEntries(Object.entries(hand.jointLimits()).map(([key, value]) => [key, [...value]])),
  poses: hand.linkPoses().length, commands, refused, before, after, pages, times,
}));
