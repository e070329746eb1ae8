// Acts on the report's page in a real browser, and records what the page draws meanwhile.
// `act(steps)` takes [[step, ...arguments], ...] and gives one answer for each; an x is in px of a plot.
(() => {
  const drawn = new WeakMap();  // by canvas
  const record = (canvas) => {
    if (!drawn.has(canvas)) drawn.set(canvas, { ops: [], cleared: 0 });
    return drawn.get(canvas);
  };
  const own = window.Path2D;
  window.Path2D = class extends own {
    constructor(from) {
      super(from);
      this.points = from ? [...from.points] : [];
    }
    moveTo(x, y) { super.moveTo(x, y); this.points.push(["M", x, y]); }
    lineTo(x, y) { super.lineTo(x, y); this.points.push(["L", x, y]); }
    arc(x, y, ...rest) { super.arc(x, y, ...rest); this.points.push(["O", x, y]); }
  };
  const parts = { left: 0, start: 0, center: 0.5, right: 1, end: 1 };
  const recorders = {
    clearRect(page) { page.ops = []; page.cleared += 1; },
    beginPath() { this.points = []; },
    moveTo(page, x, y) { (this.points ||= []).push(["M", x, y]); },
    lineTo(page, x, y) { (this.points ||= []).push(["L", x, y]); },
    stroke(page, path = this) { if (path.points?.length) page.ops.push(["path", path.points, this.strokeStyle]); },
    fill(page, path) { if (path?.points?.length) page.ops.push(["points", path.points, this.fillStyle]); },
    fillRect(page) { page.ops.push(["rect"]); },
    fillText(page, text, x, y) {
      const { a, d, e, f } = this.getTransform(), { width } = this.measureText(text);
      const left = a * x + e - parts[this.textAlign] * width;
      page.ops.push(["text", String(text), left, left + width, d * y + f]);
    },
  };
  for (const [name, recorder] of Object.entries(recorders)) {
    const plain = CanvasRenderingContext2D.prototype[name];
    CanvasRenderingContext2D.prototype[name] = function drawAndRecord(...given) {
      recorder.call(this, record(this.canvas), ...given);
      return plain.apply(this, given);
    };
  }

  const all = (selector, node = document) => [...node.querySelectorAll(selector)];
  const panels = () => all(".panel");
  const title = (panel) => panel.querySelector("h3").textContent;
  const panel = (name) => panels().find((one) => title(one).startsWith(name));
  const over = (name) => panel(name).querySelector(".u-over");
  const drawing = (one) => record(one.querySelector("canvas"));
  const ops = (name, kind) => drawing(panel(name)).ops.filter((op) => op[0] === kind);
  const field = (id) => document.getElementById(id);
  const shown = () => [field("from").value, field("to").value].map(Number);
  const settle = () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))));
  const kinds = { pointer: PointerEvent, wheel: WheelEvent, key: KeyboardEvent };
  const send = (node, type, { x = 0, ...more } = {}) => {
    const { left, top } = node.getBoundingClientRect();
    const kind = Object.keys(kinds).find((name) => type.startsWith(name));
    const event = new (kinds[kind] || MouseEvent)(type, {
      bubbles: true, cancelable: true, clientX: left + x, clientY: top + 20, movementX: 1, ...more,
    });
    node.dispatchEvent(event);
    return event;
  };
  const drag = (name, device, a, b, more) => {
    send(over(name), `${device}down`, { x: a, ...more });
    send(over(name), `${device}move`, { x: b, ...more });
    send(over(name), `${device}up`, { x: b, ...more });
    if (device === "mouse") send(over(name), "click", { x: b });
  };
  const change = (node) => node.dispatchEvent(new Event("change"));
  const steps = {
    titles: () => panels().map(title),
    box: (name) => {
      const node = over(name);
      return [node.offsetLeft, node.offsetTop, node.offsetWidth, node.offsetHeight];
    },
    press: (name, value) => { document.querySelector(`[data-${name}="${value}"]`).click(); return shown; },
    drag: (name, a, b) => { drag(name, "mouse", a, b); return shown; },
    swipe: (name, a, b) => { drag(name, "pointer", a, b, { pointerType: "touch" }); return shown; },
    click: (name, x) => { drag(name, "mouse", x, x); return () => field("cursor").textContent; },
    hover: (name, x) => { send(over(name), "mousemove", { x }); return () => field("cursor").textContent; },
    event: (name, type, more) => {
      const { defaultPrevented } = send(over(name), type, more);
      return () => [shown(), defaultPrevented];
    },
    toggle: (name, index, key) => {
      const th = all(".u-series th", panel(name))[index + 1];
      if (key) send(th, "keydown", { key });
      else th.click();
      return () => th.getAttribute("aria-pressed");
    },
    choose: (name, index) => {
      const select = panel(name).querySelector("select");
      select.selectedIndex = index;
      change(select);
      return () => all(".panel select").map((one) => one.selectedIndex);
    },
    legend: (name) => all(".u-series", panel(name)).slice(1)
      .map((row) => [".u-label", ".u-value"].map((part) => row.querySelector(part).textContent)),
    description: (name) => over(name).getAttribute("aria-label"),
    lines: (name) => ops(name, "path").map(([, points, colour]) => [colour, points]),
    points: (name) => ops(name, "points").map(([, points, colour]) => [colour, points]),
    texts: (name) => ops(name, "text").map((op) => op[1]),
    shown,
    times: () => field("cursor").textContent,
    cursors: (name) => ["pin", "u-cursor-x"].map((part) => over(name).querySelector(`.${part}`)).map((node) => {
      if (node.hidden || node.classList.contains("u-off")) return null;
      return parseFloat(node.style.left || /\((-?[\d.]+)/.exec(node.style.transform)[1]);
    }),
    type: (id, value) => { field(id).value = value; change(field(id)); return shown; },
    print: () => {
      window.dispatchEvent(new Event("beforeprint"));
      return () => {
        const found = panels().map((one) => [drawing(one).ops.length, !one.querySelector(".pin").hidden]);
        window.dispatchEvent(new Event("afterprint"));
        return found;
      };
    },
    all: () => panels().map((one) => {
      const { offsetWidth: width, offsetHeight: height } = one.querySelector("canvas");
      return { title: title(one), width, height, ops: drawing(one).ops.map(([kind, ...rest]) => (kind === "text" ? [kind, ...rest] : [kind])) };
    }),
    drawings: () => panels().map((one) => drawing(one).cleared),
    goto: (index) => {
      field("goto").selectedIndex = index;
      change(field("goto"));
      const below = (one) => Math.abs(one.getBoundingClientRect().top - parseFloat(getComputedStyle(one).scrollMarginTop));
      return () => title(panels().reduce((best, one) => (below(one) < below(best) ? one : best)));
    },
  };
  window.isDrawn = () => panels().length > 0 && panels().every((one) => drawing(one).ops.length > 0);
  window.act = async (asked) => {
    const answers = [];
    for (const [name, ...given] of asked) {
      const answer = steps[name](...given);
      await settle();
      answers.push(typeof answer === "function" ? answer() : answer);
    }
    return answers;
  };
})();
