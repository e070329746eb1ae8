// The page: what mouse, finger, keyboard, printer and window do to the shared time.

// uPlot handles the hover, the drag and the legend. The rest is here.
function listenToPlot({ plot, view }) {
  const { over } = plot, at = (event) => plot.posToVal(event.clientX - over.getBoundingClientRect().left, "x");
  let down = null;
  over.addEventListener("mousedown", (event) => { down = event.clientX; });
  over.addEventListener("click", (event) => {
    if (down === null || Math.abs(event.clientX - down) >= 4) return;  // the end of a drag
    view.pinAt(at(event), plot.posToVal(4, "x") - plot.posToVal(0, "x"));
  });
  over.addEventListener("wheel", (event) => onWheel(event, view, at(event)), { passive: false });
  over.addEventListener("keydown", (event) => onKey(event, view));
  // uPlot listens to the mouse alone, so a finger acts as one; vertical moves scroll the page
  for (const name of ["down", "move", "up"]) {
    over.addEventListener(`pointer${name}`, (event) => {
      if (event.pointerType !== "touch") return;
      const { clientX, clientY } = event;
      over.dispatchEvent(new MouseEvent(`mouse${name}`, { clientX, clientY, movementX: 1, bubbles: true }));
    });
  }
}

// With Ctrl zoom; with Shift or sideways move the time; else the page scrolls.
function onWheel(event, view, t) {
  const pixels = event.deltaMode === 1 ? 33 : 1;
  const [dx, dy] = [(event.deltaX || 0) * pixels, (event.deltaY || 0) * pixels];
  const clipped = (d) => Math.max(-100, Math.min(100, d));
  if (event.ctrlKey || event.metaKey) {
    event.preventDefault();
    view.zoom(Math.exp(clipped(dy) * 0.0025), t);
  } else if (event.shiftKey || Math.abs(dx) > Math.abs(dy)) {
    event.preventDefault();
    view.pan(clipped(dx || dy) * 0.001);
  }
}

function onKey(event, view) {
  const step = (view.to - view.from) / 100, middle = (view.from + view.to) / 2;
  const from = view.reading === null ? middle : view.reading;
  const keys = {
    ArrowLeft: () => (event.shiftKey ? view.pan(-0.2) : view.moveTo(from - step)),
    ArrowRight: () => (event.shiftKey ? view.pan(0.2) : view.moveTo(from + step)),
    Enter: () => view.pinAt(from, step / 2),
    "+": () => view.zoom(0.5, view.reading), "=": () => view.zoom(0.5, view.reading),
    "-": () => view.zoom(2, view.reading), "0": () => view.all(),
    Escape: () => (view.pin === null ? view.all() : view.pinAt(null)),
  };
  if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  keys[event.key]();
}

// The bar over the plots: move, zoom, times as numbers, go to a panel.
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

// A click on a line of the timeline shows and pins its time.
function listenToTimeline(view, main) {
  const buttons = [...document.querySelectorAll("[data-t]")];
  buttons.forEach((button) => {
    button.addEventListener("click", () => {
      const t = parseFloat(button.dataset.t), before = parseFloat(button.dataset.before || "0.5");
      view.show(t - before, t - before + Math.max(2, before + 0.5));
      view.pinAt(null);
      view.pinAt(t);
      buttons.forEach((other) => other.setAttribute("aria-current", String(other === button)));
      const { top, bottom } = main.getBoundingClientRect();
      if (top > window.innerHeight / 2 || bottom < window.innerHeight / 2) main.scrollIntoView({ block: "start" });
    });
  });
}

function listenToWindow(view) {
  const root = document.documentElement;
  const redraw = () => { view.readTheme(); view.update(); };
  window.addEventListener("resize", redraw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  window.addEventListener("beforeprint", () => { root.classList.add("print"); redraw(); });
  window.addEventListener("afterprint", () => { root.classList.remove("print"); redraw(); });
}

function start() {
  const data = JSON.parse(document.getElementById("data").textContent);
  const view = new View(data), main = document.getElementById("panels");
  data.times = gridTimes(data.grid);
  view.panels = data.panels.map((spec, index) => new Panel(spec, data, view, index === 0));
  main.append(...view.panels.map((panel) => panel.element));
  view.panels.forEach((panel) => panel.build());
  listenToBar(view);
  listenToTimeline(view, main);
  listenToWindow(view);
  view.describe();
}

start();
