"use strict";
// Runs a report's script without a browser: just enough of a document to click in, and a
// canvas that notes what is drawn. Usage: node stand_in_browser.js PAGE WIDTH STEPS, where
// STEPS is JSON: [[what, ...arguments], ...]. Prints JSON: one answer for each step.
const fs = require("fs"), vm = require("vm");

const [page, width, stepsText] = [process.argv[2], Number(process.argv[3]), process.argv[4]];
const html = fs.readFileSync(page, "utf8");
const style = /<style>([\s\S]*?)<\/style>/.exec(html)[1];
const dark = process.argv[5] === "dark";
const lists = [...style.matchAll(/:root[^{]*\{([^}]*)\}/g)].map((found) => found[1]);
const variables = {};
for (const list of lists.slice(0, dark ? 2 : 1)) {
  for (const [, name, value] of list.matchAll(/(--[\w-]+):\s*([^;]+);/g)) variables[name] = value;
}
const frames = [];

class Context {
  constructor() { this.ops = []; this.dash = []; this.saved = []; this.wiped = 0; }
  note(...op) { this.ops.push([...op, this.strokeStyle, this.fillStyle, this.lineWidth, this.dash]); }
  setTransform() { this.ops = []; }
  clearRect() { this.ops = []; this.wiped += 1; }
  measureText(text) { return { width: 6 * text.length }; }
  setLineDash(dash) { this.dash = dash; }
  save() { this.saved.push(this.clipped); }
  restore() { this.clipped = this.saved.pop(); }
  rect(...box) { this.box = box; }
  clip() { this.clipped = this.box; }
  beginPath() { this.path = []; }
  moveTo(x, y) { this.path.push(["M", x, y]); }
  lineTo(x, y) { this.path.push(["L", x, y]); }
  stroke() {
    if (!this.path.every(([, x, y]) => Number.isFinite(x) && Number.isFinite(y))) throw new Error("not finite");
    this.note("path", this.path, this.clipped || null);
  }
  fillRect(...box) { this.note("rect", box); }
  strokeText() {}  // the halo of what fillText says next
  fillText(text, x, y) { this.note("text", text, x, y, this.textAlign, this.textBaseline); }
}

class Node {
  constructor(tag) {
    Object.assign(this, { tag, children: [], listeners: {}, attributes: {}, style: {}, dataset: {}, textContent: "" });
    this.classList = { add() {}, remove() {} };
  }
  get clientWidth() { return width; }
  append(...nodes) { this.children.push(...nodes); }
  replaceChildren(...nodes) { this.children = nodes; }
  setAttribute(name, value) { this.attributes[name] = value; }
  getAttribute(name) { return this.attributes[name]; }
  addEventListener(name, listener) { (this.listeners[name] ||= []).push(listener); }
  getBoundingClientRect() { return { left: 0, top: 0, bottom: 100 }; }
  getContext() { return (this.context ||= new Context()); }
  setPointerCapture() {}
  scrollIntoView() { this.shown = true; }
  say(name, event = {}) {
    const all = { preventDefault() { this.prevented = true; }, button: 0, pointerId: 1, key: "", deltaY: 0, ...event };
    for (const listener of this.listeners[name] || []) listener.call(this, all);
    flush();
    return all;
  }
}

function flush() { while (frames.length) frames.shift()(); }

const ids = {};
for (const [, id] of html.matchAll(/ id="([\w-]+)"/g)) ids[id] = new Node(id);
ids.data.textContent = /id="data">([\s\S]*?)<\/script>/.exec(html)[1];
const buttons = { "[data-do]": [], "[data-t]": [] };
const written = /<button type="button" data-(do|t)="([^"]+)"(?: data-before="([^"]+)")?/g;
for (const [, name, value, before] of html.matchAll(written)) {
  const node = new Node("button");
  node.dataset[name] = value;
  if (before) node.dataset.before = before;
  buttons[`[data-${name}]`].push(node);
}
const windowNode = new Node("window");
const root = new Node("html");
const sandbox = {
  document: {
    createElement: (tag) => new Node(tag), getElementById: (id) => ids[id],
    querySelectorAll: (query) => buttons[query], documentElement: root, activeElement: null,
  },
  window: Object.assign(windowNode, { devicePixelRatio: 1, innerHeight: 800, matchMedia: () => new Node("media") }),
  getComputedStyle: () => ({ getPropertyValue: (name) => variables[name] || (() => { throw new Error(name); })() }),
  requestAnimationFrame: (frame) => frames.push(frame), setTimeout: () => {}, atob, console,
};
sandbox.globalThis = sandbox;
const source = html.slice(html.lastIndexOf("<script>") + 8, html.lastIndexOf("</script>"));
vm.runInNewContext(source, sandbox, { filename: "report" });
flush();

function everyNode(node) { return [node, ...node.children.filter((part) => part instanceof Node).flatMap(everyNode)]; }
const panels = ids.panels.children.map((section) => {
  const nodes = everyNode(section), found = (name) => nodes.find((node) => node.className === name);
  const [canvas, over] = nodes.filter((node) => node.tag === "canvas");
  return {
    section, title: nodes.find((node) => node.tag === "h3").textContent,
    select: nodes.find((node) => node.tag === "select"),
    canvas, over, stage: found("stage"), legend: found("legend"), read: found("read"),
  };
});
const panel = (title) => panels.find((one) => one.title.startsWith(title));
const shown = () => [ids.from.value, ids.to.value].map(Number);
const steps = {
  titles: () => panels.map((one) => one.title),
  shown,
  click: (name, value) => { buttons[`[data-${name}]`].find((one) => one.dataset[name] === value).say("click"); return shown(); },
  drag: (title, a, b) => {
    const { canvas } = panel(title);
    canvas.say("pointerdown", { clientX: a });
    canvas.say("pointermove", { clientX: b });
    canvas.say("pointerup", { clientX: b });
    return shown();
  },
  hover: (title, x) => { panel(title).canvas.say("pointermove", { clientX: x }); return ids.cursor.textContent; },
  event: (title, name, event) => { const said = panel(title).canvas.say(name, event); return [shown(), Boolean(said.prevented)]; },
  toggle: (title, index) => { const button = panel(title).legend.children[index]; button.say("click"); return button.attributes["aria-pressed"]; },
  choose: (title, index) => { const { select } = panel(title); select.selectedIndex = index; select.say("change"); return panels.filter((one) => one.select).map((one) => one.select.selectedIndex); },
  legend: (title) => panel(title).legend.children.map((node) => [node.children.filter((part) => typeof part === "string").join(""), (node.children[2] || {}).textContent]),
  read: (title) => panel(title).read.textContent,
  label: (title) => panel(title).canvas.attributes["aria-label"],
  strokes: (title) => panel(title).canvas.getContext().ops.filter((op) => op[0] === "path" && op[2]).map((op) => [op[3], op[1]]),
  rects: (title) => panel(title).canvas.getContext().ops.filter((op) => op[0] === "rect").map((op) => [op[3], op[1]]),
  times: () => ids.cursor.textContent,
  levels: (title) => [...panel(title).over.getContext().ops].map((op) => [op[0], op[0] === "path" ? op[1][0][1] : op[1]]),
  texts: (title) => panel(title).canvas.getContext().ops.filter((op) => op[0] === "text").map((op) => op[1]),
  type: (id, value) => { ids[id].value = value; ids[id].say("change"); return shown(); },
  print: () => { windowNode.say("beforeprint"); const ops = panels.map((one) => one.canvas.getContext().ops.length); windowNode.say("afterprint"); return ops; },
  all: () => panels.map((one) => ({ title: one.title, height: parseFloat(one.stage.style.height), ops: one.canvas.getContext().ops })),
  drawings: () => panels.map((one) => one.canvas.getContext().wiped),
  goto: (index) => { ids.goto.selectedIndex = index; ids.goto.say("change"); return panels.find((one) => one.section.shown).title; },
};
const answers = JSON.parse(stepsText).map(([name, ...rest]) => steps[name](...rest));
process.stdout.write(JSON.stringify(answers));
