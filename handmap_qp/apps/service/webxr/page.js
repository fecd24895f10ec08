// The page: its state in words, one card for each hand, and the way of a sample from the headset
// to the service.

import { HandSession, RobotSession, Service } from "./service.js";
import { familyGroups } from "./families.js";
import { Haptics } from "./haptics.js";
import { Robots } from "./robots.js";
import { Scene } from "./scene.js";
import { Tracking } from "./tracking.js";

const LAYOUT = "webxr25";
const SIDES = ["left", "right"];
const RATE_WINDOW = 1000; // time that rates are counted over [ms]
const SILENCE = 1000; // time without an answer after which the service counts as silent [ms]
const REFRESH = 100; // period of the page's text and drawings [ms]
// Joints of WebXR: the wrist, four of the thumb, five of each finger.
const BONES = [[1, 4], [5, 9], [10, 14], [15, 19], [20, 24]];
const COLOURS = {
  off: [0.55, 0.6, 0.66], waiting: [0.9, 0.68, 0.25], streaming: [0.3, 0.76, 0.5],
  error: [0.95, 0.45, 0.45],
};

// What each status of a robot means and what to do, with a state of the page: `loadStatuses` fills it.
let statuses = {};

const find = (selector, root = document) => root.querySelector(selector);
const search = new URLSearchParams(location.search);
const scheme = location.protocol === "https:" ? "wss:" : "ws:";
const service = new Service(`${scheme}//${location.host}/`);
const robots = new Robots(service);
const cards = SIDES.map((side) => makeCard(side));
const both = { select: find("#both"), kind: "robot", session: new RobotSession(service, LAYOUT), unknown: "" };
const tracking = new Tracking(new Scene(() => [...cards.map(describeInHeadset), describeStop()]));
let modes = null;
let failure = "";

new Haptics(cards, sessionOf, service, () => tracking.session);
service.sessions.push(both.session);
both.select.onchange = () => { both.unknown = ""; chooseAll(); };

/** The session that a hand leads: its own, or that of a robot that both lead. */
function sessionOf(card) {
  return both.select.value ? both.session : card.session;
}

function makeCard(side) {
  const root = find("#hand").content.firstElementChild.cloneNode(true);
  const session = new HandSession(service, side, LAYOUT);
  const card = { side, root, session, kind: "robot hand", joints: null, seen: false, sent: [], unknown: "" };
  card.select = find("select", root);
  root.id = side;
  find("h2", root).textContent = side === "left" ? "Left hand" : "Right hand";
  card.select.onchange = () => { card.unknown = ""; chooseAll(); };
  find(".hold", root).onclick = () => sessionOf(card).hold();
  find(".engage", root).onclick = () => sessionOf(card).engage();
  find(".clear", root).onclick = () => sessionOf(card).clear();
  find("#hands").append(root);
  service.sessions.push(session);
  return card;
}

/** Offer the service's robots; choose those of the page's address, or the usual ones. */
function offerRobots() {
  for (const card of cards) {
    const usual = service.robots.find((name) => name === `allegro_${card.side}`) ?? "";
    offer(card, service.robots, service.missing, search.get(card.side) ?? usual);
  }
  offer(both, service.twoHanded, {}, search.get("robot") ?? "");
  find("#both-field").hidden = !service.twoHanded.length && !both.unknown;
}

/** Offer robots in a selection, and choose the wanted one if nothing is chosen yet. */
function offer(one, robots, missing, usual) {
  const { select } = one;
  const offered = [...robots, "", ...Object.keys(missing)].join();
  if (one.offered === offered) return;
  one.offered = offered;
  const wanted = select.value || usual;
  select.replaceChildren(new Option("none", ""), ...familyGroups(robots, missing));
  select.value = robots.includes(wanted) ? wanted : "";
  const reason = missing[wanted] ?? `the service has no such ${one.kind}`;
  one.unknown = select.value === wanted ? "" : `${wanted}: ${reason}; choose another`;
  chooseAll();
}

/**
 * Lead the chosen robots while the headset tracks: one with both hands, or one with each. A session
 * that an emergency stop holds stays after that, so that the page can clear the stop.
 */
function chooseAll() {
  for (const one of [both, ...cards]) {
    const isKept = tracking.session || one.session.isStopped;
    const isUsed = isKept && (one === both || !both.select.value);
    const robot = isUsed ? one.select.value : "";
    if (robot !== one.session.robot) one.session.lead(robot);
  }
}

function takeFrame({ time, hands }) {
  const sessions = both.select.value ? [both.session] : cards.map(({ session }) => session);
  const sent = new Set(sessions.filter((session) => session.send(hands, time)));
  for (const card of cards) {
    card.joints = hands[card.side] ?? null;
    card.seen ||= Boolean(card.joints);
    if (sent.has(sessionOf(card)) && card.joints) card.sent.push(performance.now());
  }
}

/** State of a hand: off, waiting, streaming or error, and what to say about it. */
function stateOf(card) {
  const session = sessionOf(card);
  const last = session.lastOf(card.side);
  const { select, unknown } = both.select.value || both.unknown ? both : card;
  if (unknown) return ["error", unknown];
  if (!select.value) return ["off", "no robot chosen"];
  if (session.isStopped && service.isConnected) return ["error", "emergency stop: the robot holds"];
  if (!tracking.session) return ["off", "not started"];
  if (!service.isConnected) return ["error", "not connected: the robot holds"];
  if (session.error) return ["error", session.error];
  if (!session.isOpen) return ["waiting", `opening ${session.robot}`];
  if (last?.status === "not_following") {
    return ["error", "the robot's joints do not follow: it holds until Engage"];
  }
  if (!card.joints) {
    return ["waiting", card.seen ? "hand lost: the robot holds" : "waiting for the hand"];
  }
  if (performance.now() - session.heard > SILENCE) return ["error", "the service does not answer"];
  if (session.isReleased) return ["waiting", "streaming; the robot is held until Engage"];
  if (last?.status === "held") return ["waiting", `streaming; the robot holds: ${last.rule}`];
  return ["streaming", "streaming"];
}

function rateOf(card) {
  const now = performance.now();
  card.sent = card.sent.filter((time) => now - time < RATE_WINDOW);
  return Math.round((1000 * card.sent.length) / RATE_WINDOW);
}

function describeInHeadset(card) {
  const [state, words] = stateOf(card);
  const { robot } = sessionOf(card);
  const last = sessionOf(card).lastOf(card.side);
  const title = card.side === "left" ? "Left" : "Right";
  const status = last ? `: ${last.status}` : "";
  return {
    side: card.side, colour: COLOURS[state],
    text: [`${title}: ${words}, ${rateOf(card)} Hz`, robot ? `${robot}${status}` : ""],
  };
}

/** What the headset shows of the emergency stop, in lines that fit on its panel. */
function describeStop() {
  const stop = stopState();
  let text = ["Emergency stop: touch the red disc,", "or press B or Y. It stops every robot."];
  if (robots.isUnanswered) text = [stop[1], "Use the robot's own emergency stop."];
  else if (stop) text = [stop[1], "Leave VR, then Clear the stop on the page."];
  return { side: null, colour: COLOURS[stop ? "error" : "off"], text };
}

/** Whether this page leads the session of a name. */
function isOwn(name) {
  return service.sessions.some((session) => session.isOpen && session.name === name);
}

/** Whether this page may clear the stop of a session. */
function mayClear(name) {
  return isOwn(name) || robots.states.get(name).about.is_shared;
}

/** The emergency stop: a line, and how to go on; null if none is in force. */
function stopState() {
  if (robots.isUnanswered) {
    return ["stopped", "EMERGENCY STOP: no answer",
      "The service has not answered. Use the robot's own emergency stop."];
  }
  if (robots.stopAt !== null) return ["stopped", "EMERGENCY STOP", "Sent: waiting for the service."];
  const names = robots.stopped;
  if (!names.length) return null;
  const advice = [`Held until the stop is cleared: ${names.join(", ")}. To go on, make sure that it is safe.`];
  if (names.some(mayClear)) {
    const where = names.every(isOwn) ? "" : " where it is controlled";
    advice.push(`Press Clear the stop below, then Engage${where}.`);
  }
  const others = names.filter((name) => !mayClear(name));
  if (others.length) advice.push(`Only its owner or a supervisor may clear ${others.join(", ")}.`);
  return ["stopped", "EMERGENCY STOP", advice.join(" ")];
}

/** State of the whole: its kind, a line, and what the user can do. */
function overallState() {
  if (!service.isConnected) {
    const advice = service.attempts > 1
      ? "Is handmap serve --web running? If it requires a token, enter it below." : "";
    return ["error", "Not connected to the service", advice];
  }
  const stop = stopState();
  if (stop) return stop;
  if (!window.isSecureContext) {
    return ["error", "This address cannot use a headset",
      "WebXR needs https:// or http://localhost. Serve with --web-certificate, or forward the port: "
      + `adb reverse tcp:${location.port} tcp:${location.port}, then open http://localhost:${location.port}`];
  }
  if (modes && !modes.vr && !modes.ar) {
    return ["error", "This browser offers no headset",
      "Open this page in the headset's own browser, and allow hand tracking. "
      + "The emergency stop works in every browser."];
  }
  if (!tracking.session) return ["off", "Ready", "Choose a robot for each hand, or one for both, then start."];
  const states = cards.map((card) => stateOf(card)[0]);
  if (states.includes("error")) return ["error", "Not all is well", "See the hands below."];
  if (states.includes("streaming")) return ["streaming", "Streaming", "End stops the tracking; the robots hold."];
  return ["waiting", "Waiting for hands", "Put down controllers, and hold your hands in view."];
}

function refresh() {
  // A session that a stop kept ends when the stop is cleared.
  if (!tracking.session) chooseAll();
  const [state, line, advice] = overallState();
  find("#overview").dataset.state = state;
  find("#state").textContent = line;
  find("#advice").textContent = advice;
  find("#message").textContent = failure || robots.refusal;
  find("#service").textContent = service.isConnected
    ? `${service.address}, version ${service.version}` : `${service.address}, not connected`;
  find("#token-field").hidden = service.isConnected;
  find("#start-vr").disabled = !modes?.vr || Boolean(tracking.session) || !service.isConnected;
  find("#start-ar").hidden = !modes?.ar;
  find("#start-ar").disabled = Boolean(tracking.session) || !service.isConnected;
  find("#end").disabled = !tracking.session;
  // Whoever sees the robots may stop them, also those that others lead.
  find("#stop").disabled = !service.isConnected;
  find("#scope").textContent = describeScope();
  refreshRobots();
  cards.forEach(refreshCard);
}

/** What the button for the emergency stop stops. */
function describeScope() {
  const count = robots.states.size;
  if (!service.isConnected) return "Not connected: use the robot's own emergency stop.";
  if (!count) return "No robot is controlled now.";
  return count === 1 ? "Stops the robot of this service, whoever controls it."
    : `Stops all ${count} robots of this service, whoever controls them.`;
}

/** List the robots, also those that others lead. */
function refreshRobots() {
  const list = find("#robots");
  find("#robots-section").hidden = !robots.states.size;
  const names = [...robots.states.keys()].sort();
  const listed = Array.from(list.children, ({ dataset }) => dataset.name);
  // Items stay, so that none is replaced while it is clicked.
  if (listed.join() !== names.join()) list.replaceChildren(...names.map(makeRobot));
  for (const item of list.children) refreshRobot(item);
}

function makeRobot(name) {
  const item = find("#robot").content.firstElementChild.cloneNode(true);
  item.dataset.name = name;
  find(".name", item).textContent = name;
  find(".clear", item).onclick = () => robots.clear(name);
  return item;
}

function refreshRobot(item) {
  const { name } = item.dataset;
  const { about, mode, stop, assumed_speed: assumed } = robots.states.get(name);
  const { state, means: words } = statuses[mode] ?? { state: "off", means: mode };
  item.dataset.state = state;
  find(".model", item).textContent = about.robot;
  find(".mode", item).textContent = isOwn(name) ? `${words} (controlled by this page)` : words;
  show(find(".todo", item), adviceOn(mode));
  find(".assumed", item).hidden = !assumed?.is_often;
  find(".assumed", item).textContent = assumed?.is_often ? describeAssumed(assumed) : "";
  find(".clear", item).hidden = !stop || !mayClear(name);
}

/** What to do about a status; empty if there is nothing to do. */
function adviceOn(status) {
  const todo = statuses[status]?.do ?? "nothing";
  return todo === "nothing" ? "" : `What to do: ${todo}.`;
}

/** Show a line, or hide it where there is nothing to say. */
function show(line, words) {
  line.hidden = !words;
  line.textContent = words;
}

/** Read the table of statuses. The page, and its emergency stop, work without it. */
async function loadStatuses() {
  const answer = await fetch("statuses.json");
  if (!answer.ok) return;
  statuses = await answer.json();
  find("#statuses tbody").replaceChildren(...Object.entries(statuses).map(([status, { means, do: todo }]) => {
    const row = document.createElement("tr");
    row.append(...[status, means, todo].map((words) => {
      const cell = document.createElement("td");
      cell.textContent = words;
      return cell;
    }));
    return row;
  }));
}

/** What people must know of assumed speeds; the same words as `assumed_note` of the package. */
function describeAssumed({ share, joint }) {
  const held = `${(100 * share).toFixed(0)} % of the samples, most often ${joint}`;
  return `Assumed speed limits held a joint in ${held}: give the true ones by handmap hands init --speed.`;
}

/** What people who lead a slow hand must know; the same words as `slow_note` of the package. */
function describeSlow(fist) {
  const speeds = fist.is_assumed ? " by assumed speeds" : "";
  return `This hand needs ${fist.time.toFixed(1)} s for a fist${speeds}: a person is faster.`;
}

function refreshCard(card) {
  const { root, select } = card;
  const session = sessionOf(card);
  const [state, words] = stateOf(card);
  const last = session.lastOf(card.side);
  root.dataset.state = state;
  select.parentElement.hidden = Boolean(both.select.value);
  find(".state", root).textContent = words;
  find(".slow", root).hidden = !session.fist?.is_slow;
  find(".slow", root).textContent = session.fist?.is_slow ? describeSlow(session.fist) : "";
  const skipped = session.skipped ? `, ${session.skipped} skipped` : "";
  find(".sent", root).textContent = tracking.session ? `${rateOf(card)} Hz${skipped}` : "-";
  find(".robot", root).textContent = last?.status ?? "-";
  const means = statuses[last?.status]?.means;
  show(find(".todo", root), means ? `${last.status}: ${means}. ${adviceOn(last.status)}` : "");
  find(".flags", root).textContent = last?.flags.join(", ") || "-";
  find(".delay", root).textContent = session.delay === null ? "-" : `${session.delay.toFixed(0)} ms`;
  find(".hold", root).disabled = !session.isOpen || session.isReleased;
  find(".engage", root).disabled = !session.isOpen;
  find(".clear", root).hidden = last?.status !== "stopped";
  drawHand(find("canvas", root), card.joints);
}

/** Draw the bones of a hand as seen from where its palm is largest: from above the wrist's side. */
function drawHand(canvas, joints) {
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, canvas.width, canvas.height);
  if (!joints) return;
  const middle = [0, 1].map((axis) => joints.reduce((sum, point) => sum + point[axis], 0) / joints.length);
  const scale = canvas.height / 0.21; // [px/m]
  const place = ([x, y]) => [
    canvas.width / 2 + scale * (x - middle[0]), canvas.height / 2 - scale * (y - middle[1]),
  ];
  context.strokeStyle = context.fillStyle = getComputedStyle(canvas).color;
  context.lineWidth = 5;
  context.lineCap = context.lineJoin = "round";
  for (const [first, last] of BONES) {
    context.beginPath();
    context.moveTo(...place(joints[0]));
    for (let i = first; i <= last; i += 1) context.lineTo(...place(joints[i]));
    context.stroke();
  }
  for (const joint of joints) {
    context.beginPath();
    context.arc(...place(joint), 6, 0, 2 * Math.PI);
    context.fill();
  }
}

/** Emergency stop of every robot of the service. */
function stopAll() {
  robots.stop();
  refresh();
}

async function start(mode) {
  failure = "";
  for (const card of cards) card.seen = false;
  try {
    await tracking.start(mode);
    chooseAll();
  } catch (error) {
    failure = error.name === "NotSupportedError"
      ? "The headset does not offer hand tracking to this browser: allow it in the settings."
      : `The headset did not start: ${error.message}`;
  }
  refresh();
}

find("#start-vr").onclick = () => start("vr");
find("#start-ar").onclick = () => start("ar");
find("#end").onclick = () => tracking.stop();
find("#stop").onclick = stopAll;
find("#token").onchange = (event) => {
  service.token = event.target.value.trim();
  service.connect();
};
tracking.addEventListener("stop", stopAll);
tracking.addEventListener("frame", (event) => takeFrame(event.detail));
tracking.addEventListener("end", () => {
  for (const card of cards) card.joints = null;
  chooseAll();
  refresh();
});
service.addEventListener("change", () => {
  if (service.isConnected) offerRobots();
  else robots.forget();
  refresh();
});
addEventListener("pagehide", () => service.sessions.forEach((session) => session.lead("")));
service.token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
service.connect();
loadStatuses().then(refresh, () => {});
Tracking.modes().then((offered) => {
  modes = offered;
  refresh();
});
setInterval(refresh, REFRESH);
