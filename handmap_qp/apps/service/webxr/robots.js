// The robots of the service, whoever leads them: what each of them does, their emergency stop, and
// its clearing.

const PERIOD = 500; // of asking what the robots do [ms]
const PATIENCE = 2000; // time after which a question that has no answer is asked again [ms]
const SILENCE = 1000; // time without an answer after which a stop counts as unanswered [ms]

export class Robots {
  /** @param service the service, which is asked again and again once it is connected. */
  constructor(service) {
    this.service = service;
    this.forget();
    setInterval(() => this.poll(), PERIOD);
  }

  forget() {
    this.states = new Map(); // the newest answer about each session, by its public name
    this.askedAt = -Infinity; // time of the question that has no answer yet [ms]
    this.stopAt = null; // time of the emergency stop that has no answer yet [ms]
    this.refusal = ""; // why the service refused to stop a robot, or to clear a stop
  }

  /** Names of the robots that an emergency stop holds. */
  get stopped() {
    return [...this.states.keys()].filter((name) => this.states.get(name).stop);
  }

  /** Whether an emergency stop was sent, and the service does not answer. */
  get isUnanswered() {
    return this.stopAt !== null && performance.now() - this.stopAt > SILENCE;
  }

  /** Ask which sessions there are, and what the robot of each does. */
  poll() {
    const now = performance.now();
    if (!this.service.isConnected || now - this.askedAt < PATIENCE) return;
    this.askedAt = now;
    this.service.ask({ type: "status" }, { receive: (reply) => this.receiveNames(reply) });
  }

  receiveNames(reply) {
    this.askedAt = -Infinity;
    if (reply.type !== "state") return;
    for (const name of this.states.keys()) if (!reply.names.includes(name)) this.states.delete(name);
    for (const name of reply.names) this.askAbout(name);
  }

  askAbout(name) {
    this.service.ask({ type: "status", name }, {
      receive: (reply) => {
        if (reply.type === "state") this.states.set(name, reply);
        else this.states.delete(name); // it has ended meanwhile
      },
    });
  }

  /** Emergency stop of every robot of the service: they brake and hold until `clear`. */
  stop() {
    this.refusal = "";
    const isSent = this.service.ask(
      { type: "stop", reason: "a page in a browser" },
      { receive: (reply) => this.receiveStop(reply) },
    );
    // Without a connection it is unanswered at once.
    this.stopAt = isSent ? performance.now() : -Infinity;
  }

  receiveStop(reply) {
    this.stopAt = null;
    this.refusal = reply.type === "error" ? reply.message : "";
    this.pollNow();
  }

  /** Clear the emergency stop of a robot that this page has seen. */
  clear(name) {
    this.refusal = "";
    this.service.ask({ type: "clear", name, stop: this.states.get(name).stop }, {
      receive: (reply) => {
        this.refusal = reply.type === "error" ? reply.message : "";
        this.pollNow();
      },
    });
  }

  pollNow() {
    this.askedAt = -Infinity;
    this.poll();
  }
}
