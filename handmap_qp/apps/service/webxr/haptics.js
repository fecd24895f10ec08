// What the robot's fingers feel: a bar for each finger on the page, and a pulse of controllers.

const FORCE = [0.1, 5.0]; // force that is felt first, and that is felt most [N]
const EFFORT = [0.05, 1.0]; // the same of a load, as a share of the largest
const PERIOD = 50; // time between pulses [ms]
const PULSE = 100; // length of a pulse [ms]: the next one comes before it ends

/** Strength of a pulse, 0 to 1: 0 up to the first value, 1 from the last one on. */
function scaled(value, [first, last]) {
  return Math.min(1, Math.max(0, (value - first) / (last - first)));
}

/** Strength by finger of the newest haptics of a session; none if they are older than `life` [ms]. */
function strengths(haptics, life) {
  const found = new Map();
  if (!haptics || performance.now() - haptics.arrived > life) return found;
  const add = (values, range) => {
    for (const [finger, value] of Object.entries(values ?? {})) {
      found.set(finger, Math.max(found.get(finger) ?? 0, scaled(value, range)));
    }
  };
  add(haptics.efforts, EFFORT);
  add(haptics.forces, FORCE);
  return found;
}

/** The fingers of one hand; those of a robot with two hands have names such as left.thumb. */
function ofSide(found, side) {
  const own = new Map();
  for (const [finger, strength] of found) {
    const [first, last] = finger.split(".");
    if (last === undefined) own.set(first, strength);
    else if (first === side) own.set(last, strength);
  }
  return own;
}

/** Gamepads that vibrate for a side: controllers of the headset, and those without a hand. */
function gamepads(xrSession, side) {
  const held = Array.from(xrSession?.inputSources ?? [])
    .filter((source) => source.gamepad && source.handedness === side)
    .map((source) => source.gamepad);
  const others = Array.from(navigator.getGamepads?.() ?? [])
    .filter((pad) => pad && (!pad.hand || pad.hand === side));
  return new Set([...held, ...others]);
}

/** Pulse each actuator of a gamepad. */
function pulse(gamepad, strength) {
  const ignore = () => {}; // a controller that was just put down
  if (gamepad.hapticActuators?.length) {
    for (const actuator of gamepad.hapticActuators) actuator.pulse(strength, PULSE)?.catch?.(ignore);
  } else if (gamepad.vibrationActuator) {
    gamepad.vibrationActuator.playEffect("dual-rumble", {
      duration: PULSE, strongMagnitude: strength, weakMagnitude: strength,
    })?.catch?.(ignore);
  }
}

/** Shows what fingers feel in the cards of the hands, and gives it to controllers. */
export class Haptics {
  constructor(cards, sessionOf, service, xrSession) {
    this.cards = cards;
    this.sessionOf = sessionOf;
    this.service = service; // says for how long haptics count
    this.xrSession = xrSession;
    this.bars = new Map(cards.map((card) => [card, this.makeBars(card)]));
    setInterval(() => this.refresh(), PERIOD);
  }

  makeBars(card) {
    const bars = document.createElement("div");
    bars.className = "haptics";
    bars.hidden = true;
    card.root.querySelector("dl").before(bars);
    return bars;
  }

  refresh() {
    const strongest = new Map(); // by gamepad: one without a hand gets the stronger of both
    for (const card of this.cards) {
      const found = ofSide(strengths(this.sessionOf(card).haptics, this.service.hapticsLife), card.side);
      this.show(this.bars.get(card), found);
      const strength = Math.max(0, ...found.values());
      if (strength === 0) continue;
      for (const pad of gamepads(this.xrSession(), card.side)) {
        strongest.set(pad, Math.max(strongest.get(pad) ?? 0, strength));
      }
    }
    for (const [pad, strength] of strongest) pulse(pad, strength);
  }

  show(bars, found) {
    bars.hidden = !found.size;
    const names = [...found.keys()];
    const shown = Array.from(bars.children, ({ dataset }) => dataset.finger);
    if (shown.join() !== names.join()) bars.replaceChildren(...names.map(makeBar));
    for (const bar of bars.children) bar.lastChild.value = found.get(bar.dataset.finger);
  }
}

function makeBar(finger) {
  const bar = document.createElement("label");
  bar.dataset.finger = finger;
  bar.append(finger, document.createElement("meter"));
  return bar;
}
