// A saved hand follows a person's: the library in C (handmap/handmap.h), compiled to WebAssembly.

const LANDMARKS = 63;
const POSE = 16;
const KINDS = ["", "input", "hand", "failed", "failed"]; // by handmap_result
// Where the fields of the structs of handmap.h are with pointers of 32 bits. Their sizes end the lists.
const SAMPLE = { time: 0, landmarks: 8, wrist: 12, valid: 16, confidence: 24, arrival: 32, dt: 40, size: 48 };
const COMMAND = {
  time: 0, wrist: 8, q: 136, velocity: 140, joints: 144, status: 148, isHeld: 152, isGliding: 156,
  rule: 160, mistake: 164, size: 168,
};
const OPTIONS = { rejoin: 0, smooths: 4, acceleration: 8, speedGain: 16, size: 24 };
const BYTES = 8; // of a number

export class HandmapError extends Error {
  constructor(kind, problem) {
    super(problem);
    this.name = "HandmapError";
    this.kind = kind;
  }
}

export async function loadLibrary(source) {
  const imports = {
    env: { emscripten_notify_memory_growth: () => {} },
    wasi_snapshot_preview1: {
      proc_exit: (code) => {
        throw new Error(`handmap.wasm ended with ${code}`);
      },
    },
  };
  const { instance } = await WebAssembly.instantiate(await bytesOf(source), imports);
  instance.exports._initialize();
  return new Library(instance.exports);
}

async function bytesOf(source) {
  let found = await source;
  if (typeof found === "string" || found instanceof URL) found = await fetch(found);
  if (!(found instanceof Response)) return found;
  if (!found.ok) throw new HandmapError("failed", `${found.url}: ${found.status} ${found.statusText}`);
  return found.arrayBuffer();
}

export class Library {
  constructor(c) {
    this.c = c;
    this.version = this.textAt(c.handmap_version());
  }

  loadHand(bytes, options = {}) {
    return new Hand(this, new Uint8Array(bytes), options);
  }

  // -- memory, whose views end where it grows

  textAt(address) {
    if (!address) return "";
    const memory = new Uint8Array(this.c.memory.buffer);
    return new TextDecoder().decode(memory.slice(address, memory.indexOf(0, address)));
  }
  numbersAt(address, count) {
    return new Float64Array(this.c.memory.buffer, address, count);
  }
  get view() {
    return new DataView(this.c.memory.buffer);
  }
  allocate(size) {
    const address = this.c.malloc(size);
    if (!address) throw new HandmapError("failed", "out of memory");
    return address;
  }

  check(result) {
    if (result !== 0) throw new HandmapError(KINDS[result], this.textAt(this.c.handmap_last_error()));
  }
}

export class Hand {
  constructor(library, bytes, options) {
    this.library = library;
    const { c } = library;
    this.address = load(library, bytes, options);
    this.name = library.textAt(c.handmap_name(this.address));
    this.side = library.textAt(c.handmap_side(this.address));
    this.dt = c.handmap_usual_dt(this.address);
    this.jointNames = this.names(c.handmap_joint_count, c.handmap_joint_name);
    this.humanJointNames = this.names(c.handmap_human_joint_count, c.handmap_human_joint_name);
    this.linkNames = this.names(c.handmap_link_count, c.handmap_link_name);
    const poses = POSE * this.linkNames.length;
    const limits = this.jointNames.length * BYTES;
    this.room = new Room(library, {
      lower: limits,
      upper: limits,
      speed: limits,
      landmarks: LANDMARKS * BYTES,
      wrist: POSE * BYTES,
      humanQ: this.humanJointNames.length * BYTES,
      poses: poses * BYTES,
      sample: SAMPLE.size,
      command: COMMAND.size,
    });
  }

  follow(sample) {
    const { room, library } = this;
    const landmarks = this.write("landmarks", sample.landmarks, LANDMARKS);
    const wrist = sample.wrist ? this.write("wrist", sample.wrist, POSE) : 0;
    const { view } = library;
    const to = room.sample;
    view.setFloat64(to + SAMPLE.time, sample.time, true);
    view.setUint32(to + SAMPLE.landmarks, landmarks, true);
    view.setUint32(to + SAMPLE.wrist, wrist, true);
    view.setInt32(to + SAMPLE.valid, (sample.valid ?? true) ? 1 : 0, true);
    view.setFloat64(to + SAMPLE.confidence, sample.confidence ?? 1.0, true);
    view.setFloat64(to + SAMPLE.arrival, sample.arrival ?? NaN, true);
    view.setFloat64(to + SAMPLE.dt, sample.dt ?? NaN, true);
    return this.commanded(library.c.handmap_follow(this.address, to, room.command));
  }

  mapLandmarks(landmarks, dt, wrist = null) {
    const from = this.write("landmarks", landmarks, LANDMARKS);
    const at = wrist ? this.write("wrist", wrist, POSE) : 0;
    const { c } = this.library;
    return this.commanded(c.handmap_map_landmarks(this.address, from, at, dt, this.room.command));
  }

  mapJoints(humanQ, wrist, dt) {
    const from = this.write("humanQ", humanQ, this.humanJointNames.length);
    const at = this.write("wrist", wrist, POSE);
    const { c } = this.library;
    return this.commanded(c.handmap_map_joints(this.address, from, at, dt, this.room.command));
  }

  hold(dt) {
    return this.commanded(this.library.c.handmap_hold(this.address, dt, this.room.command));
  }

  stop(dt) {
    return this.commanded(this.library.c.handmap_stop(this.address, dt, this.room.command));
  }

  engage() {
    this.library.check(this.library.c.handmap_engage(this.address));
  }

  disengage() {
    this.library.check(this.library.c.handmap_disengage(this.address));
  }

  linkPoses() {
    const { library, room } = this;
    library.check(library.c.handmap_link_poses(this.address, room.poses));
    return library.numbersAt(room.poses, POSE * this.linkNames.length).slice();
  }

  jointLimits() {
    const { library, room } = this;
    library.check(library.c.handmap_joint_limits(this.address, room.lower, room.upper, room.speed));
    const numbers = (address) => library.numbersAt(address, this.jointNames.length).slice();
    return { lower: numbers(room.lower), upper: numbers(room.upper), speed: numbers(room.speed) };
  }

  humanLandmarks(humanQ, wrist) {
    const { library, room } = this;
    const from = this.write("humanQ", humanQ, this.humanJointNames.length);
    const at = this.write("wrist", wrist, POSE);
    library.check(library.c.handmap_human_landmarks(this.address, from, at, room.landmarks));
    return library.numbersAt(room.landmarks, LANDMARKS).slice();
  }

  free() {
    if (!this.address) return;
    this.library.c.handmap_free(this.address);
    this.room.free();
    this.address = 0;
  }

  // -- to and from the library

  names(count, name) {
    return Array.from({ length: count(this.address) }, (_, i) => this.library.textAt(name(this.address, i)));
  }

  /** Write numbers where the library reads them; return the address. */
  write(name, numbers, count) {
    if (numbers?.length !== count)
      throw new HandmapError("input", `${name}: expected ${count} numbers, got ${numbers?.length ?? numbers}`);
    this.library.numbersAt(this.room[name], count).set(numbers);
    return this.room[name];
  }

  commanded(result) {
    const { library } = this;
    library.check(result);
    const { view } = library;
    const from = this.room.command;
    const joints = view.getUint32(from + COMMAND.joints, true);
    const numbers = (field) => library.numbersAt(view.getUint32(from + field, true), joints).slice();
    const text = (field) => library.textAt(view.getUint32(from + field, true));
    return {
      time: view.getFloat64(from + COMMAND.time, true),
      q: numbers(COMMAND.q),
      velocity: numbers(COMMAND.velocity),
      wrist: library.numbersAt(from + COMMAND.wrist, POSE).slice(),
      status: library.textAt(library.c.handmap_status_name(view.getInt32(from + COMMAND.status, true))),
      isHeld: view.getInt32(from + COMMAND.isHeld, true) !== 0,
      isGliding: view.getInt32(from + COMMAND.isGliding, true) !== 0,
      rule: text(COMMAND.rule),
      mistake: text(COMMAND.mistake),
    };
  }
}

/** Memory of the library, a part for each name. */
class Room {
  constructor(library, sizes) {
    this.library = library;
    for (const [name, size] of Object.entries(sizes)) this[name] = library.allocate(size || BYTES);
    this.parts = Object.keys(sizes);
  }

  free() {
    for (const name of this.parts) this.library.c.free(this[name]);
  }
}

/** Load a hand; return its address. */
function load(library, bytes, { rejoin = "glide", smoothing }) {
  const { c } = library;
  if (rejoin !== "glide" && rejoin !== "clutch")
    throw new HandmapError("input", `rejoin: expected glide or clutch, got ${rejoin}`);
  const room = new Room(library, { bytes: bytes.length, options: OPTIONS.size, hand: BYTES });
  try {
    new Uint8Array(c.memory.buffer, room.bytes, bytes.length).set(bytes);
    c.handmap_default_options(room.options);
    const { view } = library;
    view.setInt32(room.options + OPTIONS.rejoin, rejoin === "clutch" ? 1 : 0, true);
    if (smoothing === null) view.setInt32(room.options + OPTIONS.smooths, 0, true);
    if (smoothing) {
      view.setFloat64(room.options + OPTIONS.acceleration, smoothing.acceleration, true);
      view.setFloat64(room.options + OPTIONS.speedGain, smoothing.speedGain, true);
    }
    library.check(c.handmap_load(room.bytes, bytes.length, room.options, room.hand));
    return library.view.getUint32(room.hand, true);
  } finally {
    room.free();
  }
}
