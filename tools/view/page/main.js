// The page: shows the server's frames and sends the person's orders.
import { Plots } from "./plots.js";
import { recordedRun } from "./recorded.js";
import { MODE_COLOURS, RobotScene } from "./scene.js";

const $ = (id) => document.getElementById(id);
const css = (colour) => `#${colour.toString(16).padStart(6, "0")}`;
const HINTS = {
  record: "drag: rotate the view · wheel: zoom · space: play or pause · ← →: step by a frame",
  live: "drag: rotate the view · wheel: zoom",
  led: "drag the torso up or down: lead · shift-drag the torso: push · drag elsewhere: rotate the view",
};
const WORDS = { suspended: "frozen; press start to resume" };
const CUTS = ["left leg", "right leg", "all"];
const HEIGHT_STEP = 0.02, PITCH_STEP = 0.05, PUSH_PER_PIXEL = 0.6, FRAME_S = 1 / 30;

let model, scene, plots, newest, socket;
const hand = { height: 0, pitch: 0, led: false };

function send(message) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

// True if an E-STOP could not be sent; the page sends it after reconnecting.
let stopWaits = false;

function stop() {
  stopWaits = socket.readyState !== WebSocket.OPEN;
  if (stopWaits) complain("E-STOP not sent: no connection to the server. Cut the power.");
  else send({ order: "estop" });
}

function complain(text) {
  $("error").textContent = text;
  $("error").hidden = !text;
}

function serverSocket() {
  const here = new URL("ws", location.href);
  here.protocol = "ws:";
  return new WebSocket(here);
}

async function connect() {
  socket = await recordedRun() ?? serverSocket();
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.model) begin(message.model);
    if (message.error) complain(message.error);
    if (message.frame) show(message.frame);
    if (message.playing !== undefined) $("play").textContent = message.playing ? "⏸" : "▶";
  };
  socket.onclose = () => {
    if (!stopWaits) complain("no connection to the server; retrying");
    setTimeout(connect, 1000);
  };
  socket.onopen = () => {
    complain("");
    if (stopWaits) stop();
  };
}

function row(list, name) {
  const item = document.createElement("li");
  const dot = Object.assign(document.createElement("span"), { className: "dot" });
  const label = Object.assign(document.createElement("span"), { className: "name", textContent: name });
  const word = Object.assign(document.createElement("span"), { className: "word" });
  item.append(dot, label, word);
  list.append(item);
  return { item, dot, word };
}

let moduleRows = [];

function begin(given) {
  if (model) return;
  model = given;
  $("source").textContent = model.title;
  document.title = `XRL: ${model.robot}, ${model.source}`;
  $("hint").textContent = HINTS[model.orders.includes("hand") ? "led" : model.source];
  moduleRows = model.modules.map((name) => {
    const made = row($("modules"), name.replace("_", " "));
    const way = Object.assign(document.createElement("span"), { className: "way" });
    made.item.append(way);
    return { ...made, way };
  });
  plots = new Plots($("plots"), model.course ?? []);
  if (model.source !== "record") $("stall").textContent = "waiting for states from all modules";
  try {
    scene = new RobotScene($("scene"), model);
  } catch (error) {
    complain(`3-D view not available: ${error.message}`);
  }
  if (model.end_s > model.begin_s) beginTimeline();
  if (model.orders.length || model.source === "live") beginOrders();
  steer();
}

function beginTimeline() {
  $("timeline").hidden = false;
  Object.assign($("place"), { min: model.begin_s, max: model.end_s, value: 0 });
  for (const mark of model.marks) {
    const tick = document.createElement("i");
    tick.className = mark.kind;
    tick.title = `${mark.t_s.toFixed(2)} s: ${mark.text}`;
    tick.style.left = `${100 * (mark.t_s - model.begin_s) / (model.end_s - model.begin_s)}%`;
    $("marks").append(tick);
  }
  $("play").onclick = () => send({ play: $("play").textContent === "▶" });
  $("place").oninput = () => send({ play: false, seek_s: Number($("place").value) });
  $("rate").onchange = () => send({ rate: Number($("rate").value) });
  $("back").onclick = () => step(-FRAME_S);
  $("forth").onclick = () => step(FRAME_S);
}

const step = (by_s) => send({ play: false, seek_s: (newest?.t_s ?? 0) + by_s });

function beginOrders() {
  const acts = model.orders.includes("estop");
  $("estop").hidden = $("hardware").hidden = !acts;
  $("estop").onclick = stop;
  $("processes").hidden = !acts;
  for (const name of model.processes) addProcess(name);
  $("cuts").hidden = !model.orders.includes("cut");
  for (const service of CUTS) $("cuts").append(button(`cut links: ${service}`, { order: "cut", service }));
}

const processRows = new Map();

function button(text, message) {
  const made = document.createElement("button");
  made.textContent = text;
  Object.assign(made.dataset, message);
  made.onclick = () => send(message);
  return made;
}

function addProcess(service) {
  const made = row($("processes").querySelector("ul"), service);
  made.dot.remove();
  for (const order of ["kill", "freeze", "start"])
    if (model.orders.includes(order)) made.item.append(button(order, { order, service }));
  const way = Object.assign(document.createElement("span"), { className: "way" });
  made.item.append(way);
  made.word = way;
  processRows.set(service, made);
  return made;
}

function showProcesses(frame) {
  if (frame.processes.length) $("processes").hidden = false;
  for (const process of frame.processes) {
    const { word, item } = processRows.get(process.name) ?? addProcess(process.name);
    word.textContent = process.state === "running" ? "" : WORDS[process.state] ?? process.state;
    item.title = `${process.state}, restarts: ${process.restarts}`;
  }
  $("network").hidden = !(frame.network.length || model.orders.includes("cut"));
  $("impaired").textContent = frame.network.length ? frame.network.join("; ") : "not impaired";
}

function show(frame) {
  newest = frame;
  $("time").textContent = frame.t_s.toFixed(1);
  $("height").textContent = frame.torso[2].toFixed(3);
  $("stall").textContent = frame.stall;
  $("hand").textContent = Math.round(frame.force[2]) || 0;  // never -0
  const planner = frame.planner, age = Math.max(...frame.ages_ms);
  $("age").textContent = age >= 0 ? age.toFixed(0) : "–";
  $("margin").textContent = planner ? planner.margin.toFixed(2) : "–";
  $("mode").textContent = planner ? planner.mode.toLowerCase() : "silent";
  $("planner").textContent = planner
    ? [planner.why, planner.wearer, planner.wait_s > 0 ? `leads again in ${planner.wait_s.toFixed(0)} s at the earliest` : "",
      planner.heat_left_s >= 0 && planner.heat_left_s < 3600 ? `a module gets too warm in ${planner.heat_left_s.toFixed(0)} s at this load` : "",
      `tick ${planner.tick_us?.toFixed(0) ?? "-"} µs, assist ${planner.assist_n.toFixed(0)} N, carries ${planner.carried_n.toFixed(0)} N`]
      .filter(Boolean).join("; ")
    : "silent: each module holds on its own";
  frame.modes.forEach((mode, index) => {
    const name = model.modes[mode] ?? "SILENT";
    moduleRows[index].word.textContent = name;
    moduleRows[index].way.textContent = frame.ways_out[index];
    moduleRows[index].dot.style.background = css(MODE_COLOURS[name]);
  });
  if (frame.fallen) complain("the robot has fallen");
  if (!$("timeline").hidden && document.activeElement !== $("place")) $("place").value = frame.t_s;
  if (!hand.led) Object.assign(hand, { height: frame.torso[2], pitch: frame.angles[1] });
  const [right, left] = frame.soles.map(([force]) => `${force[2].toFixed(0)} N`);
  $("soles").textContent = !right ? "unknown: a leg is too straight"
    : `right ${right}, left ${left}${!frame.soles_estimated ? "" : "; estimated from the joint torques"}`;
  showProcesses(frame);
  scene?.show(frame);
  plots.take(frame);
}

function lead(height, pitch) {
  Object.assign(hand, { height, pitch, led: true });
  send({ order: "hand", height, pitch });
}

// Dragging the torso leads or pushes the robot; dragging elsewhere rotates the view.
function steer() {
  const canvas = $("scene"), pointers = new Map();
  const leads = model.orders.includes("hand");
  let grip, pushing;
  const letGo = () => {
    clearInterval(pushing);
    pushing = grip = undefined;
    if (leads) send({ order: "push", force: [0, 0, 0] });
  };
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus();
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pushing) letGo();
    const held = leads && pointers.size === 1 && scene?.isTorso(event.offsetX, event.offsetY);
    grip = held ? { x: event.clientX, y: event.clientY, force: [0, 0, 0], ...hand } : undefined;
    if (grip && event.shiftKey)  // repeated, because a push expires
      pushing = setInterval(() => send({ order: "push", force: grip.force }), 50);
  };
  canvas.onpointermove = (event) => {
    const last = pointers.get(event.pointerId);
    if (!last || !scene) return;
    const dx = event.clientX - last.x, dy = event.clientY - last.y;
    Object.assign(last, { x: event.clientX, y: event.clientY });
    if (pushing) {
      const right = scene.right(), size = PUSH_PER_PIXEL * (event.clientX - grip.x);
      const up = -PUSH_PER_PIXEL * (event.clientY - grip.y);
      grip.force = [right.x * size, right.y * size, up];
    } else if (grip) {
      lead(grip.height - (event.clientY - grip.y) * scene.metresPerPixel(), grip.pitch);
    } else {
      scene.look.azimuth -= dx * 0.006;
      scene.look.elevation = Math.min(1.4, Math.max(-0.1, scene.look.elevation + dy * 0.006));
      scene.draw();
    }
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => {
    pointers.delete(event.pointerId);
    if (grip || pushing) letGo();
  };
  canvas.onwheel = (event) => {
    event.preventDefault();
    if (!scene) return;
    scene.look.distance = Math.min(9, Math.max(1.2, scene.look.distance * Math.exp(event.deltaY * 0.001)));
    scene.draw();
  };
  addEventListener("keydown", (event) => {
    if (event.target instanceof HTMLSelectElement || event.target instanceof HTMLInputElement) return;
    const recorded = !$("timeline").hidden;
    const { height, pitch } = hand;
    const actions = recorded
      ? { " ": () => $("play").click(), ArrowLeft: () => step(-FRAME_S), ArrowRight: () => step(FRAME_S) }
      : leads ? {
        ArrowUp: () => lead(height + HEIGHT_STEP, pitch), ArrowDown: () => lead(height - HEIGHT_STEP, pitch),
        ArrowLeft: () => lead(height, pitch - PITCH_STEP), ArrowRight: () => lead(height, pitch + PITCH_STEP),
      } : {};
    const action = actions[event.key];
    if (!action || (event.target instanceof HTMLButtonElement && event.key === " ")) return;
    event.preventDefault();
    action();
  });
}

connect();
