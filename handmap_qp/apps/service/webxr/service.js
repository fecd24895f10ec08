// Connection to the mapping service, and one session for each hand or for a robot that both lead: the
// messages of service/messages.md as JSON over the WebSocket of the page's own address.

const PROTOCOL = 2;
const SUBPROTOCOL = "handmap.v1";
const RETRY = 1000; // time until a lost connection is tried again [ms]
const MOST_WAITING = 32768; // bytes that wait to be sent, above which samples are skipped
const REMEMBERED = 1024; // requests whose sender is remembered

/** 24 random characters: the secret of a session. */
function makeSecret() {
  const bytes = crypto.getRandomValues(new Uint8Array(18));
  return btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_");
}

/** Joint positions [m] as a sample has them; of a hand that is not seen, that it is not. */
function handSample(joints) {
  if (!joints) return { valid: false };
  return { values: joints.flat().map((value) => Math.round(value * 1e5) / 1e5) };
}

/** A session: one human hand that leads one robot hand. */
export class HandSession {
  constructor(service, side, layout) {
    this.service = service;
    this.side = side;
    this.layout = layout;
    this.name = `webxr-${side}`;
    this.forget("");
  }

  forget(robot) {
    this.robot = robot;
    this.secret = "";
    this.isOpen = false;
    this.isReleased = false;
    this.last = null; // the newest command, before the first one the posture of the opened session
    this.heard = performance.now(); // time of the newest reply [ms]
    this.delay = null; // from the time stamp of a sample to its command [ms]
    this.fist = null; // how long the robot takes for a fist; servers before it do not say
    this.haptics = null; // what the robot's fingers feel, and when that arrived
    this.error = "";
    this.skipped = this.attempts = 0;
  }

  /** Open the session for a robot, or end it where there is none. */
  lead(robot) {
    if (this.isOpen) this.ask({ type: "close" });
    this.forget(robot);
    if (robot) this.open(false);
  }

  /** Open the session; with `restore`, go on where its robot is. */
  open(restore) {
    if (!restore) this.secret = makeSecret(); // the server knows the owner by it
    this.isRestoring = restore;
    const start = restore ? {
      restore, is_released: this.isReleased, robot_q: this.last?.q, robot_wrist: this.last?.wrist,
    } : {};
    this.ask({
      type: "open", name: this.name, robot: this.robot, ...this.choices(), input: "landmarks",
      layout: this.layout, has_detail: true, is_shared: true, ...start,
    });
  }

  /** What `open` says of the hands. */
  choices() {
    return { side: this.side };
  }

  ask(request) {
    return this.service.ask({ session: this.secret, ...request }, this);
  }

  /** Send joint positions of hands by side [m], with their time stamp [ms]. */
  send(hands, time) {
    if (!this.isOpen) return false;
    if (this.service.waiting > MOST_WAITING) {
      this.skipped += 1;
      return false;
    }
    return this.ask({ type: "sample", time: time / 1000, ...this.sampleOf(hands) });
  }

  sampleOf(hands) {
    return handSample(hands[this.side]);
  }

  /** Whether an emergency stop holds the robot. */
  get isStopped() {
    return this.last?.status === "stopped";
  }

  /** What the newest command says of a hand. */
  lastOf() {
    return this.last;
  }

  hold() {
    this.ask({ type: "release" });
  }

  engage() {
    this.ask({ type: "clutch" });
  }

  /** Clear the emergency stop that is in force; the robot is then released. */
  clear() {
    this.ask({ type: "status" });
  }

  receive(reply) {
    this.heard = performance.now();
    if (reply.type === "opened") {
      this.isOpen = true;
      this.attempts = 0;
      this.error = "";
      this.fist = reply.fist ?? null;
      this.last ??= { q: reply.q, wrist: null, status: "waiting", flags: [] };
      this.service.ask({ type: "subscribe", name: this.name }, this);
      this.service.ask({ type: "subscribe", name: this.name, stream: "haptics" }, this);
    } else if (reply.type === "command") {
      this.last = reply;
      this.isReleased = reply.flags.includes("released");
      if (reply.flags.includes("watchdog")) return;
      this.delay = this.heard - reply.time * 1000;
      this.error = "";
    } else if (reply.type === "state") {
      if (reply.stop) this.ask({ type: "clear", stop: reply.stop });
    } else if (reply.type === "error") {
      this.receiveError(reply);
    }
  }

  receiveError({ code, field, message }) {
    if (code === "no_session" && this.isOpen) {
      this.isOpen = false;
      this.open(true);
    } else if (field === "name" && !this.isOpen && !this.isRestoring && code === "invalid") {
      this.open(true); // the session of this page before it was loaded again
    } else if (code === "busy" && field === "name" && (this.attempts += 1) < 4) {
      const { secret } = this; // this page before it was loaded again owns the session for 2 s yet
      setTimeout(() => { if (!this.isOpen && this.secret === secret) this.open(true); }, RETRY);
    } else {
      if (code === "taken") this.isOpen = false;
      this.error = [field, message].filter(Boolean).join(": ");
    }
  }
}

/** A session: both human hands lead one robot. */
export class RobotSession extends HandSession {
  constructor(service, layout) {
    super(service, "both", layout);
  }

  choices() {
    return {};
  }

  sampleOf({ left, right }) {
    return { hands: { left: handSample(left), right: handSample(right) } };
  }

  lastOf(side) {
    const { last } = this;
    // These are of the whole robot, whatever its hands say.
    const isWhole = ["stopped", "not_following"].includes(last?.status);
    return isWhole ? last : last && { ...last, ...last.hands?.[side] };
  }
}

/** The WebSocket, connected again whenever it is lost. */
export class Service extends EventTarget {
  constructor(address) {
    super();
    this.address = address;
    this.token = "";
    this.robots = [];
    this.twoHanded = []; // robots that both hands lead
    this.missing = {}; // why each robot hand that is not installed cannot be led
    this.version = "";
    this.hapticsLife = 0; // time after which what a finger felt no longer counts [ms]
    this.sessions = [];
    this.isConnected = false;
    this.attempts = 0;
    this.seq = 0;
    this.senders = new Array(REMEMBERED).fill(null);
  }

  get waiting() {
    return this.socket ? this.socket.bufferedAmount : 0;
  }

  connect() {
    clearTimeout(this.retry);
    const offered = this.token ? [SUBPROTOCOL, `bearer.${this.token}`] : [SUBPROTOCOL];
    let socket;
    try {
      socket = new WebSocket(this.address, offered);
    } catch { // a token with characters that no subprotocol may have
      this.attempts += 1;
      this.changed();
      return;
    }
    if (this.socket) this.socket.onclose = this.socket.onmessage = null, this.socket.close();
    this.socket = socket;
    socket.onopen = () => this.ask({ type: "status" }, null);
    socket.onmessage = (event) => this.receive(JSON.parse(event.data));
    socket.onclose = () => {
      this.isConnected = false;
      this.attempts += 1;
      for (const session of this.sessions) session.isOpen = false;
      this.retry = setTimeout(() => this.connect(), RETRY);
      this.changed();
    };
  }

  /** Send a request; true if it could be sent. */
  ask(request, sender) {
    if (!this.socket || this.socket.readyState !== WebSocket.OPEN) return false;
    this.seq += 1;
    this.senders[this.seq % REMEMBERED] = sender;
    this.socket.send(JSON.stringify({ protocol: PROTOCOL, seq: this.seq, ...request }));
    return true;
  }

  receive(reply) {
    const sender = this.senders[reply.seq % REMEMBERED];
    if (reply.type === "haptics") {
      const session = this.sessions.find(({ name }) => name === reply.name);
      if (session) session.haptics = { ...reply, arrived: performance.now() };
      return;
    }
    if (reply.type === "command") {
      this.sessions.find((session) => session.name === reply.name)?.receive(reply);
    } else if (reply.type === "state" && !sender) {
      this.robots = reply.robots;
      this.twoHanded = reply.two_handed ?? [];
      this.missing = reply.missing;
      this.version = reply.version;
      this.hapticsLife = 1000 * reply.haptics_life;
      this.isConnected = true;
      this.attempts = 0;
      // A lost connection leaves the session behind: go on where its robot is.
      for (const session of this.sessions) if (session.robot) session.open(true);
    } else {
      sender?.receive(reply);
    }
    if (reply.type !== "command") this.changed();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }
}
