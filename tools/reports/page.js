// The page: what the hand, the keyboard, the printer and the window do to the shared time.

function listen(panel, view) {
  const canvas = panel.canvas;
  const at = (event) => panel.timeAt(event.clientX - canvas.getBoundingClientRect().left);
  const pixels = (n) => n * (view.to - view.from) / Math.max(1, panel.box.right - panel.box.left);
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
    else view.pinAt(at(event), pixels(4));
  });
  canvas.addEventListener("pointercancel", () => { start = view.drag = null; view.point(null); });
  canvas.addEventListener("pointerleave", () => { if (start === null) view.point(null); });
  canvas.addEventListener("dblclick", () => view.all());
  canvas.addEventListener("wheel", (event) => turn(event, view, at(event)), { passive: false });
  canvas.addEventListener("keydown", (event) => press(event, view));
}

// With Ctrl zoom, with Shift or sideways move the time; else the page is scrolled.
function turn(event, view, t) {
  const lines = event.deltaMode === 1 ? 33 : 1;
  const [dx, dy] = [(event.deltaX || 0) * lines, (event.deltaY || 0) * lines];
  const clipped = (d) => Math.max(-100, Math.min(100, d));
  if (event.ctrlKey || event.metaKey) {
    event.preventDefault();
    view.zoom(Math.exp(clipped(dy) * 0.0025), t);
  } else if (event.shiftKey || Math.abs(dx) > Math.abs(dy)) {
    event.preventDefault();
    view.pan(clipped(dx || dy) * 0.001);
  }
}

function press(event, view) {
  const step = (view.to - view.from) / 100, middle = (view.from + view.to) / 2;
  const from = view.reading === null ? middle : view.reading;
  const keys = {
    ArrowLeft: () => (event.shiftKey ? view.pan(-0.2) : view.point(from - step)),
    ArrowRight: () => (event.shiftKey ? view.pan(0.2) : view.point(from + step)),
    Enter: () => view.pinAt(from, step / 2),
    "+": () => view.zoom(0.5, view.reading), "=": () => view.zoom(0.5, view.reading),
    "-": () => view.zoom(2, view.reading), "0": () => view.all(),
    Escape: () => (view.pin === null ? view.all() : view.pinAt(null)),
  };
  if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  keys[event.key]();
}

// The bar over the plots: moving, zooming, the time in numbers, going to a panel.
function listenToBar(view) {
  const moves = {
    left: () => view.pan(-0.5), right: () => view.pan(0.5), all: () => view.all(),
    in: () => view.zoom(0.5, view.reading), out: () => view.zoom(2, view.reading),
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
  const goto = document.getElementById("goto");
  view.panels.forEach((panel) => goto.append(make("option", "", panel.spec.title)));
  goto.addEventListener("change", () => {
    const panel = view.panels[goto.selectedIndex - 1];
    if (panel) panel.element.scrollIntoView({ block: "start" });
    goto.selectedIndex = 0;
  });
}

// A line of what happened shows its moment, in the plots that are in sight.
function listenToTimeline(view, main) {
  const buttons = [...document.querySelectorAll("[data-t]")];
  buttons.forEach((button) => {
    button.addEventListener("click", () => {
      const t = parseFloat(button.dataset.t), before = parseFloat(button.dataset.before || "0.5");
      view.show(t - before, t - before + Math.max(2, before + 0.5));
      view.pin = t;
      buttons.forEach((other) => other.setAttribute("aria-current", String(other === button)));
      const { top, bottom } = main.getBoundingClientRect();
      if (top > window.innerHeight / 2 || bottom < window.innerHeight / 2) main.scrollIntoView({ block: "start" });
      view.redraw();
    });
  });
}

function listenToWindow(view) {
  const root = document.documentElement, again = () => { view.readTheme(); view.redraw(); };
  window.addEventListener("scroll", () => view.redraw(), { passive: true });
  window.addEventListener("resize", () => {
    view.panels.forEach((panel) => panel.layout());
    view.redraw();
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
  window.addEventListener("beforeprint", () => {
    root.classList.add("print");
    view.printing = true;
    view.readTheme();
    view.draw(true);
  });
  window.addEventListener("afterprint", () => {
    root.classList.remove("print");
    view.printing = false;
    view.panels.forEach((panel) => panel.layout());
    again();
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
  listenToBar(view);
  listenToTimeline(view, main);
  listenToWindow(view);
  view.panels.forEach((panel) => panel.layout());  // each has its height, before any is drawn
  view.draw(false);
  const rest = [...view.panels];
  const next = () => {  // the others while nothing else is to be done, so that none is empty
    const panel = rest.shift();
    if (!panel) return;
    panel.draw(view.theme);
    setTimeout(next);
  };
  setTimeout(next);
}

start();
