"use strict";
// A document for the page's script in node: elements, events, and canvases that record what is drawn.
// Usage: node stand_in_browser.js PAGE WIDTH STEPS THEME; STEPS is JSON: [[step, ...arguments], ...].
// Prints JSON: one answer for each step.
const fs = require("fs"), vm = require("vm");

const [page, widthText, stepsText, theme] = process.argv.slice(2);
const html = fs.readFileSync(page, "utf8"), width = Number(widthText);
const style = /<style>([\s\S]*?)<\/style>/.exec(html)[1];
const variables = {};
for (const [, list] of [...style.matchAll(/:root[^{]*\{([^}]*)\}/g)].slice(0, theme === "dark" ? 2 : 1)) {
  for (const [, name, value] of list.matchAll(/(--[\w-]+):\s*([^;]+);/g)) variables[name] = value;
}
const queue = [];  // microtasks and frames

function flush() { while (queue.length) queue.shift()(); }

class Path {
  constructor(points) {
    if (points && !(points instanceof Path)) throw new Error("unknown argument");
    this.points = points ? [...points.points] : [];
  }
  moveTo(x, y) { this.add("M", x, y); }
  lineTo(x, y) { this.add("L", x, y); }
  arc(x, y) { this.add("O", x, y); }
  rect() {}
  add(kind, x, y) {
    if (!Number.isFinite(x) || !Number.isFinite(y)) throw new Error("not finite");
    this.points.push([kind, x, y]);
  }
}

class Context extends Path {
  constructor(canvas) {
    super();
    Object.assign(this, { canvas, ops: [], cleared: 0 });
  }
  clearRect() { this.ops = []; this.cleared += 1; }
  measureText(text) { return { width: 6 * String(text).length }; }
  beginPath() { this.points = []; }
  stroke(path = this) { if (path.points.length) this.ops.push(["path", path.points, this.strokeStyle]); }
  fill(path) { if (path.points.length) this.ops.push(["points", path.points, this.fillStyle]); }
  fillRect(...box) { this.ops.push(["rect", box, this.fillStyle]); }
  fillText(text, x, y) { this.ops.push(["text", String(text), x, y, this.textAlign]); }
}
for (const name of ["save", "restore", "scale", "translate", "clip", "setLineDash", "strokeText"]) {
  Context.prototype[name] = () => {};
}

class Element {
  constructor(tag) {
    Object.assign(this, { tag, childNodes: [], listeners: [], attributes: {}, style: {}, dataset: {}, className: "" });
    this.classList = {
      contains: (name) => this.className.split(" ").includes(name),
      add: (name) => { this.className = `${this.className} ${name}`.trim(); },
      remove: (name) => { this.className = this.className.split(" ").filter((one) => one !== name).join(" "); },
    };
  }
  get clientWidth() { return width; }
  get firstChild() { return this.childNodes[0]; }
  get children() { return this.childNodes.filter((node) => node instanceof Element); }
  get all() { return this.children.flatMap((node) => [node, ...node.all]); }
  get textContent() {
    return this.childNodes.map((node) => (node instanceof Element ? node.textContent : node.nodeValue)).join("");
  }
  set textContent(text) { this.childNodes = [{ nodeValue: text }]; }
  append(...nodes) { nodes.forEach((node) => this.insertBefore(node)); }
  appendChild(node) { this.insertBefore(node); }
  insertBefore(node, next) {
    const child = node instanceof Element ? node : { nodeValue: node };
    child.parent = this;
    this.childNodes.splice(next ? this.childNodes.indexOf(next) : this.childNodes.length, 0, child);
  }
  remove() { if (this.parent) this.parent.childNodes = this.parent.childNodes.filter((node) => node !== this); }
  setAttribute(name, value) { this.attributes[name] = value; }
  getAttribute(name) { return this.attributes[name]; }
  getContext() { return (this.context ||= new Context(this)); }
  scrollIntoView() { this.scrolledTo = true; }
  getBoundingClientRect() { return { left: parseFloat(this.style.left) || 0, top: 0, bottom: 100 }; }
  querySelectorAll(selector) {
    const [parent, tag] = selector.split(" ");
    return this.all.filter((node) => node.tag === tag && node.parent.classList.contains(parent.slice(1)));
  }
  one(name) { return this.all.find((node) => node.classList.contains(name) || node.tag === name); }
  addEventListener(name, listener, options) {
    this.listeners.push({ name, listener, capture: Boolean(options && options.capture) });
  }
  removeEventListener(name, listener) {
    this.listeners = this.listeners.filter((one) => one.name !== name || one.listener !== listener);
  }
  dispatchEvent(event) {
    event.target = this;
    const path = [];
    for (let node = this; node; node = node.parent) path.push(node);
    path.push(documentNode, windowNode);
    const run = (nodes, capture) => nodes.forEach((node) => node.listeners
      .filter((one) => one.name === event.type && (node === this || one.capture === capture))
      .forEach((one) => one.listener.call(node, event)));
    run(path.slice(1).reverse(), true);
    run([this], false);
    run(path.slice(1), false);
  }
  click() { this.send("click"); }
  send(type, more = {}) {
    const event = new Event(type, { clientY: 20, ...more });
    this.dispatchEvent(event);
    flush();
    return event;
  }
}

class Event {
  constructor(type, more) { Object.assign(this, { type, button: 0, movementX: 1, key: "", deltaY: 0, ctrlKey: false, metaKey: false }, more); }
  preventDefault() { this.prevented = true; }
  stopPropagation() {}
  stopImmediatePropagation() {}
}

const documentNode = new Element("document"), windowNode = new Element("window"), ids = {};
for (const [, id] of html.matchAll(/ id="([\w-]+)"/g)) ids[id] = new Element(id);
ids.data.textContent = /id="data">([\s\S]*?)<\/script>/.exec(html)[1];
const buttons = { "[data-do]": [], "[data-t]": [] };
for (const [, name, value, before] of html.matchAll(/<button type="button" data-(do|t)="([^"]+)"(?: data-before="([^"]+)")?/g)) {
  const button = new Element("button");
  button.dataset[name] = value;
  if (before) button.dataset.before = before;
  buttons[`[data-${name}]`].push(button);
}
const sandbox = {
  document: Object.assign(documentNode, {
    createElement: (tag) => new Element(tag), getElementById: (id) => ids[id], activeElement: null,
    querySelectorAll: (selector) => buttons[selector], documentElement: new Element("html"),
  }),
  window: Object.assign(windowNode, { innerHeight: 800 }),
  matchMedia: () => new Element("media"), devicePixelRatio: 1, navigator: { language: "en" },
  getComputedStyle: () => ({ getPropertyValue: (name) => variables[name] || (() => { throw new Error(name); })() }),
  requestAnimationFrame: (frame) => queue.push(frame), queueMicrotask: (task) => queue.push(task),
  HTMLElement: Element, Path2D: Path, CustomEvent: Event, MouseEvent: Event, atob, console,
};
windowNode.matchMedia = sandbox.matchMedia;
for (const [, script] of html.matchAll(/<script(?: id="uplot")?>([\s\S]*?)<\/script>/g)) {
  vm.runInNewContext(script, vm.isContext(sandbox) ? sandbox : vm.createContext(sandbox), { filename: "report" });
}
flush();

const panels = ids.panels.children;
const title = (panel) => panel.one("h3").textContent;
const panel = (name) => panels.find((one) => title(one).startsWith(name));
const over = (name) => panel(name).one("u-over");
const context = (one) => one.one("canvas").getContext();
const ops = (name, kind) => context(panel(name)).ops.filter((op) => op[0] === kind);
const shown = () => [ids.from.value, ids.to.value].map(Number);
const left = (name) => parseFloat(over(name).style.left);
const drag = (target, names, a, b, more) => {
  target.send(`${names}down`, { clientX: a, ...more });
  target.send(`${names}move`, { clientX: b, ...more });
  target.send(`${names}up`, { clientX: b, ...more });
};
const steps = {
  titles: () => panels.map(title),
  shown,
  press: (name, value) => { buttons[`[data-${name}]`].find((one) => one.dataset[name] === value).click(); return shown(); },
  drag: (name, a, b) => { drag(over(name), "mouse", a, b); over(name).send("click", { clientX: b }); return shown(); },
  swipe: (name, a, b) => { drag(over(name), "pointer", a, b, { pointerType: "touch" }); return shown(); },
  click: (name, x) => { drag(over(name), "mouse", x, x); over(name).send("click", { clientX: x }); return ids.cursor.textContent; },
  hover: (name, x) => { over(name).send("mousemove", { clientX: x }); return ids.cursor.textContent; },
  event: (name, type, event) => { const { prevented } = over(name).send(type, event); return [shown(), Boolean(prevented)]; },
  toggle: (name, index, key) => {
    const th = panel(name).querySelectorAll(".u-series th")[index + 1];
    if (key) th.send("keydown", { key });
    else th.click();
    return th.attributes["aria-pressed"];
  },
  choose: (name, index) => {
    const select = panel(name).one("select");
    select.selectedIndex = index;
    select.send("change");
    return panels.map((one) => one.one("select")).filter(Boolean).map((one) => one.selectedIndex);
  },
  legend: (name) => panel(name).all.filter((node) => node.classList.contains("u-series")).slice(1)
    .map((row) => [row.one("u-label").textContent, row.one("u-value").textContent]),
  description: (name) => over(name).attributes["aria-label"],
  lines: (name) => ops(name, "path").map(([, points, colour]) => [colour, points]),
  points: (name) => ops(name, "points").map(([, points, colour]) => [colour, points]),
  texts: (name) => ops(name, "text").map((op) => op[1]),
  times: () => ids.cursor.textContent,
  cursors: (name) => ["pin", "u-cursor-x"].map((one) => panel(name).one(one)).map((node) => {
    if (node.hidden || node.classList.contains("u-off")) return null;
    return left(name) + parseFloat(node.style.left || /\((-?[\d.]+)/.exec(node.style.transform)[1]);
  }),
  type: (id, value) => { ids[id].value = value; ids[id].send("change"); return shown(); },
  print: () => {
    windowNode.send("beforeprint");
    const drawn = panels.map((one) => [context(one).ops.length, !one.one("pin").hidden]);
    windowNode.send("afterprint");
    return drawn;
  },
  all: () => panels.map((one) => ({ title: title(one), height: parseFloat(one.one("u-wrap").style.height), ops: context(one).ops })),
  drawings: () => panels.map((one) => context(one).cleared),
  goto: (index) => { ids.goto.selectedIndex = index; ids.goto.send("change"); return title(panels.find((one) => one.scrolledTo)); },
};
process.stdout.write(JSON.stringify(JSON.parse(stepsText).map(([name, ...rest]) => steps[name](...rest))));
