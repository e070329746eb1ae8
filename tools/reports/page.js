// The page: the time that all panels share, and what changes it.

class View {
  constructor(data) {
    [this.begin, this.end] = data.span;
    if (!(this.end > this.begin)) this.end = this.begin + 1;
    Object.assign(this, { from: this.begin, to: this.end, cursor: null, drag: null, panels: [] });
    this.pending = false;
    this.theme = () => "";
  }

  show(from, to) {
    const least = 0.005, whole = this.end - this.begin;
    const length = Math.min(whole, Math.max(least, to - from));
    const start = Math.min(this.end - length, Math.max(this.begin, (from + to - length) / 2));
    [this.from, this.to] = [start, start + length];
    this.redraw();
  }

  zoom(factor, at) {
    const t = at === undefined || at === null ? (this.from + this.to) / 2 : at;
    this.show(t - (t - this.from) * factor, t + (this.to - t) * factor);
  }

  pan(share) {
    const by = (this.to - this.from) * share;
    this.show(this.from + by, this.to + by);
  }

  all() { this.show(this.begin, this.end); }

  point(t) {
    this.cursor = t === null ? null : Math.min(this.end, Math.max(this.begin, t));
    if (t !== null && (this.cursor < this.from || this.cursor > this.to)) {
      const half = (this.to - this.from) / 2;
      this.show(this.cursor - half, this.cursor + half);
    }
    this.redraw();
  }

  choose(spec, index) {
    for (const panel of this.panels) {
      if (panel.spec.choices && panel.spec.group === spec.group) panel.choose(index);
    }
    this.redraw();
  }

  readTheme() {
    const style = getComputedStyle(document.documentElement), known = new Map();
    this.theme = (name) => {
      if (!known.has(name)) known.set(name, style.getPropertyValue(name).trim());
      return known.get(name);
    };
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => { this.pending = false; this.draw(false); });
  }

  // Draw the panels that can be seen; all of them for the printer.
  draw(everything) {
    for (const panel of this.panels) {
      const place = panel.canvas.getBoundingClientRect();
      const seen = place.bottom > -100 && place.top < window.innerHeight + 100;
      if (everything || seen) panel.draw(this.theme);
    }
    const at = this.cursor === null ? "" : `t = ${this.cursor.toFixed(3)} s`;
    document.getElementById("cursor").textContent = at;
    for (const [id, value] of [["from", this.from], ["to", this.to]]) {
      const field = document.getElementById(id);
      if (document.activeElement !== field) field.value = value.toFixed(3);
    }
  }
}

function listen(panel, view) {
  const canvas = panel.canvas;
  const at = (event) => panel.timeAt(event.clientX - canvas.getBoundingClientRect().left);
  let start = null;
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    start = event.clientX;
    view.drag = [at(event), at(event)];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (start !== null) view.drag[1] = at(event);
    view.point(at(event));
  });
  canvas.addEventListener("pointerup", (event) => {
    if (start === null) return;
    const [a, b] = view.drag, far = Math.abs(event.clientX - start) > 4;
    start = view.drag = null;
    if (far && a !== b) view.show(Math.min(a, b), Math.max(a, b));
    else view.point(at(event));
  });
  canvas.addEventListener("pointercancel", () => { start = view.drag = null; view.redraw(); });
  canvas.addEventListener("pointerleave", () => { if (start === null) view.point(null); });
  canvas.addEventListener("dblclick", () => view.all());
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;  // else the page could not be scrolled
    event.preventDefault();
    view.zoom(Math.exp(Math.sign(event.deltaY) * 0.25), at(event));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = (view.to - view.from) / 100, from = view.cursor === null ? (view.from + view.to) / 2 : view.cursor;
    const keys = {
      ArrowLeft: () => (event.shiftKey ? view.pan(-0.2) : view.point(from - step)),
      ArrowRight: () => (event.shiftKey ? view.pan(0.2) : view.point(from + step)),
      "+": () => view.zoom(0.5, view.cursor), "=": () => view.zoom(0.5, view.cursor),
      "-": () => view.zoom(2, view.cursor), "0": () => view.all(), Escape: () => view.all(),
    };
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
  });
}

function start() {
  const data = JSON.parse(document.getElementById("data").textContent);
  const view = new View(data), main = document.getElementById("panels");
  view.readTheme();
  data.panels.forEach((spec, index) => {
    const panel = new Panel(spec, data, view, index === 0);
    view.panels.push(panel);
    main.append(panel.element);
    listen(panel, view);
  });
  for (const panel of view.panels) if (panel.spec.choices) panel.choose(panel.spec.initial);
  const moves = {
    left: () => view.pan(-0.5), right: () => view.pan(0.5), all: () => view.all(),
    in: () => view.zoom(0.5, view.cursor), out: () => view.zoom(2, view.cursor),
  };
  document.querySelectorAll("[data-do]").forEach((button) => {
    button.addEventListener("click", moves[button.dataset.do]);
  });
  const from = document.getElementById("from"), to = document.getElementById("to");
  for (const field of [from, to]) {
    field.addEventListener("change", () => {
      const a = parseFloat(from.value), b = parseFloat(to.value);
      if (b > a) view.show(a, b);
    });
  }
  document.querySelectorAll("[data-t]").forEach((button) => {
    button.addEventListener("click", () => {
      const t = parseFloat(button.dataset.t);
      view.show(t - 0.5, t + 1.5);
      view.point(t);
      main.scrollIntoView({ block: "start" });
    });
  });
  const again = () => { view.readTheme(); view.redraw(); };
  window.addEventListener("scroll", () => view.redraw(), { passive: true });
  window.addEventListener("resize", () => view.redraw());
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
  window.addEventListener("beforeprint", () => {
    document.documentElement.classList.add("print");
    view.readTheme();
    view.draw(true);
  });
  window.addEventListener("afterprint", () => {
    document.documentElement.classList.remove("print");
    again();
  });
  view.panels.forEach((panel) => panel.draw(view.theme));  // once: gives each its height
  view.draw(true);
}

start();
