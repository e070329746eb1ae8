// One panel: a plot, over it a canvas with the cursor, its legend; both follow the shared time.

const MARK_COLOURS = {
  kill: "--bad", fall: "--bad", estop: "--bad", fault: "--warn", network: "--warn", restart: "--good", push: "--muted",
};
// Signals that vary by less are drawn flat: what is left of them is rounding.
const LEAST = {
  mm: 0.01, m: 1e-5, rad: 1e-5, "rad/s": 1e-4, N: 0.01, "N m": 0.01, ms: 0.01, "\u00b5s": 1, Hz: 1, count: 1,
};
const ROW = 18, ROW_NARROW = 30, MARKS_ROOM = 44;

class Panel {
  constructor(spec, data, view, first) {
    Object.assign(this, { spec, data, view, first, choice: 0, drawn: "" });
    this.element = make("section", "panel");
    const [top, select] = topOf(spec, (index) => view.choose(spec, index));
    this.select = select;
    this.legend = new Legend(spec, () => view.redraw());
    this.stage = make("div", "stage");
    this.canvas = make("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.over = make("canvas", "cursor");
    this.stage.append(this.canvas, this.over);
    if (this.legend.read) {  // few words: beside the title
      top.append(this.legend.element);
      this.element.append(top, this.stage, this.legend.read);
    } else this.element.append(top, this.stage, this.legend.element);
    this.fillLegend();
  }

  get set() { return this.spec.choices ? this.spec.choices[this.choice] : this.spec; }

  get lines() { return this.set.lines || []; }

  get limits() { return this.set.limits || []; }

  choose(index) {
    this.choice = Math.min(index, this.spec.choices.length - 1);
    this.select.selectedIndex = this.choice;
    this.fillLegend();
  }

  fillLegend() {
    this.legend.fill(this.lines);
    this.canvas.setAttribute("aria-label", this.inWords());
  }

  inWords() {
    const told = this.spec.kind === "bars"
      ? this.spec.rows.map((row) => `${row.label}, ${row.spans.length} stretches`)
      : this.lines.map((line) => {
        const { lo, hi } = this.data.signals[line.signal];
        return `${line.label} from ${inWords(lo)} to ${inWords(hi)} ${this.spec.unit}`;
      });
    return `${this.spec.title}: ${told.join("; ")}`;
  }

  get height() {
    if (this.spec.kind !== "bars") return (this.narrow ? 150 : 170) + (this.first ? MARKS_ROOM : 0);
    return this.spec.rows.length * (this.narrow ? ROW_NARROW : ROW) + 24;
  }

  // The part of the canvas that holds the data; the same left and right in every panel.
  layout() {
    const width = this.stage.clientWidth || 600;
    this.narrow = width < 560;
    this.box = {
      left: this.narrow ? 50 : 100, right: width - 10,
      top: this.first ? MARKS_ROOM : 6, bottom: this.height - 18,
    };
    this.width = width;
    this.stage.style.height = `${this.height}px`;
  }

  draw(theme) {
    this.layout();
    const { from, to } = this.view;
    const ratio = window.devicePixelRatio || 1;
    const hidden = [...this.legend.hidden].join();
    const drawn = [from, to, this.width, this.height, ratio, this.choice, hidden, this.view.look].join();
    const x = (t) => this.box.left + ((t - from) / (to - from)) * (this.box.right - this.box.left);
    if (drawn !== this.drawn || this.view.printing) {
      this.drawn = this.view.printing ? "" : drawn;
      const ctx = this.wiped(this.canvas, ratio);
      this.timeAxis(ctx, theme, x);
      if (this.spec.kind === "bars") this.drawBars(ctx, theme, x);
      else this.drawLines(ctx, theme, x);
      this.drawMarks(ctx, theme, x);
      if (this.view.printing) this.drawCursor(ctx, theme, x);  // on paper two canvases hide each other
    }
    this.drawCursor(this.wiped(this.over, ratio), theme, x);
    this.legend.readAt(this.view.reading, this.data.signals);
  }

  wiped(canvas, ratio) {
    const pixels = [Math.round(this.width * ratio), Math.round(this.height * ratio)];
    if (canvas.width !== pixels[0]) canvas.width = pixels[0];
    if (canvas.height !== pixels[1]) canvas.height = pixels[1];
    const ctx = canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, this.width, this.height);
    ctx.font = "11px system-ui, sans-serif";
    return ctx;
  }

  timeAxis(ctx, theme, x) {
    const { box } = this, { from, to } = this.view;
    const [values, digits] = ticks(from, to, (box.right - box.left) / 64);
    ctx.lineWidth = 1;
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    for (const t of values) {
      const px = Math.round(x(t)) + 0.5, text = `${inDigits(t, digits)} s`;
      ctx.strokeStyle = theme("--grid");
      line(ctx, px, box.top, px, box.bottom);
      ctx.fillStyle = theme("--muted");
      ctx.fillText(text, Math.min(px, this.width - ctx.measureText(text).width / 2), box.bottom + 4);
    }
  }

  range() {
    const { from, to } = this.view;
    let low = Infinity, high = -Infinity;
    const take = (value) => { low = Math.min(low, value); high = Math.max(high, value); };
    for (const one of this.lines) {
      if (this.legend.hidden.has(one.label)) continue;
      const found = extentIn(this.data.signals[one.signal], from, to);
      if (found) found.forEach(take);
    }
    this.limits.filter((limit) => limit.shown).forEach((limit) => take(limit.value));
    if (this.spec.reach) high = Math.max(low, Math.min(high, this.spec.reach));
    if (low > high) return [0, 1];
    const size = Math.max(Math.abs(low), Math.abs(high));
    const least = Math.max(LEAST[this.spec.unit] || 1e-3, size * 1e-4);
    const pad = Math.max((high - low) * 0.06, (least - (high - low)) / 2);
    return [low - pad, high + pad];
  }

  drawLines(ctx, theme, x) {
    const { box } = this, { from, to } = this.view, [low, high] = this.range();
    const y = (value) => box.bottom - ((value - low) / (high - low)) * (box.bottom - box.top);
    this.valueAxis(ctx, theme, y, low, high);
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    ctx.clip();
    const levels = this.limits.map((limit) => [Math.round(y(limit.value)) + 0.5, limit.label])
      .filter(([py]) => py >= box.top && py <= box.bottom);
    levels.forEach(([py]) => this.drawLevel(ctx, theme, py));
    ctx.lineWidth = 1.3;
    for (const one of this.lines) {
      if (this.legend.hidden.has(one.label)) continue;
      ctx.strokeStyle = theme(`--c${one.colour % 8}`);
      ctx.setLineDash(one.dashed ? [5, 3] : []);
      drawSignal(ctx, this.data.signals[one.signal], from, to, x, y);
    }
    ctx.setLineDash([]);
    ctx.restore();
    this.nameLevels(ctx, theme, levels);
  }

  valueAxis(ctx, theme, y, low, high) {
    const { box } = this;
    const [values, digits] = ticks(low, high, (box.bottom - box.top) / 28);
    let texts = values.map((value) => inDigits(value, digits));
    const widest = Math.max(...texts.map((text) => ctx.measureText(text).width));
    if (widest > box.left - 6) texts = values.map((value) => inPowers(value, values));
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    values.forEach((value, index) => {
      const py = Math.round(y(value)) + 0.5;
      ctx.strokeStyle = theme("--grid");
      line(ctx, box.left, py, box.right, py);
      ctx.fillStyle = theme("--muted");
      ctx.fillText(texts[index], box.left - 5, py);
    });
  }

  drawLevel(ctx, theme, py) {
    ctx.strokeStyle = theme("--bad");
    ctx.lineWidth = 1;
    ctx.setLineDash([2, 3]);
    line(ctx, this.box.left, py, this.box.right, py);
    ctx.setLineDash([]);
  }

  // Names of levels, over the lines; those that are close stand side by side, or once.
  nameLevels(ctx, theme, levels) {
    const { box } = this, taken = [];
    ctx.textAlign = "right";
    for (const [py, label] of levels) {
      const over = py - box.top > 14, at = over ? py - 7 : py + 7;
      const beside = taken.filter(([other]) => Math.abs(other - at) < 15);
      if (beside.some(([, , text]) => text === label)) continue;
      const right = Math.min(box.right - 2, ...beside.map(([, left]) => left - 8));
      const width = ctx.measureText(label).width;
      if (right - width < box.left) continue;
      taken.push([at, right - width, label]);
      ctx.textBaseline = "middle";
      haloed(ctx, theme, label, right, at, "--bad");
    }
  }

  drawBars(ctx, theme, x) {
    const { box } = this, { from, to } = this.view, row = this.narrow ? ROW_NARROW : ROW;
    this.spec.rows.forEach((one, number) => {
      const top = box.top + number * row, text = this.narrow ? 12 : 0;
      ctx.fillStyle = theme("--fg");
      ctx.textAlign = this.narrow ? "left" : "right";
      ctx.textBaseline = "middle";
      if (this.narrow) ctx.fillText(one.label, box.left, top + 6);
      else ctx.fillText(one.label, box.left - 5, top + row / 2);
      for (const [begin, end, code] of one.spans) {
        if (end < from || begin > to) continue;
        const a = Math.max(box.left, x(begin)), b = Math.min(box.right, Math.max(x(end), x(begin) + 1));
        const [name, colour] = this.spec.codes[code];
        ctx.fillStyle = theme(`--${colour}`);
        ctx.fillRect(a, top + text + 1, b - a, row - text - 3);
        if (b - a > ctx.measureText(name).width + 8) {
          ctx.fillStyle = theme(`--on-${colour}`);
          ctx.textAlign = "center";
          ctx.fillText(name, (a + b) / 2, top + text + (row - text) / 2);
        }
      }
    });
  }

  // Marks of what happened; in the first panel with their names.
  drawMarks(ctx, theme, x) {
    const { box } = this;
    const free = [-Infinity, -Infinity, -Infinity];  // three rows of names
    ctx.lineWidth = 1;
    for (const [t, kind, label] of this.data.marks) {
      const px = Math.round(x(t)) + 0.5;
      if (px < box.left || px > box.right) continue;
      ctx.strokeStyle = ctx.fillStyle = theme(MARK_COLOURS[kind] || "--muted");
      ctx.setLineDash([4, 3]);
      line(ctx, px, box.top, px, box.bottom);
      ctx.setLineDash([]);
      const width = ctx.measureText(label).width;
      const left = Math.min(Math.max(px - width / 2, box.left), box.right - width);
      const row = free.findIndex((end) => left >= end);
      if (!this.first || row < 0) continue;
      ctx.textAlign = "left";
      ctx.textBaseline = "bottom";
      ctx.fillText(label, left, box.top - 3 - 13 * row);
      free[row] = left + width + 6;
    }
  }

  drawCursor(ctx, theme, x) {
    const { box } = this, { drag, cursor, pin, from, to } = this.view;
    const shown = (t) => t !== null && t >= from && t <= to;
    if (drag) {
      ctx.fillStyle = theme("--select");
      const a = Math.max(box.left, Math.min(x(drag[0]), x(drag[1])));
      const b = Math.min(box.right, Math.max(x(drag[0]), x(drag[1])));
      ctx.fillRect(a, box.top, b - a, box.bottom - box.top);
    }
    for (const [t, colour, width] of [[pin, "--focus", 2], [cursor, "--fg", 1]]) {
      if (!shown(t)) continue;
      ctx.strokeStyle = theme(colour);
      ctx.lineWidth = width;
      const px = Math.round(x(t)) + 0.5;
      line(ctx, px, box.top, px, box.bottom);
    }
  }

  timeAt(px) {
    this.layout();
    const { left, right } = this.box, { from, to } = this.view;
    return Math.min(to, Math.max(from, from + ((px - left) / (right - left)) * (to - from)));
  }
}
