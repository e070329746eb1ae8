// One panel: a canvas, its legend, and how both follow the shared time.

const MARK_COLOURS = { kill: "--bad", estop: "--bad", fault: "--warn", restart: "--good", push: "--muted" };
const ROW = 18, ROW_NARROW = 30;

class Panel {
  constructor(spec, data, view, first) {
    Object.assign(this, { spec, data, view, first, choice: 0, hidden: new Set(), met: new Set() });
    this.element = document.createElement("section");
    this.element.className = "panel";
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.legend = document.createElement("div");
    this.legend.className = "legend";
    this.element.append(this.makeTop(), this.canvas, this.legend);
    if (spec.kind === "bars") {
      this.read = document.createElement("div");
      this.read.className = "read";
      this.element.append(this.read);
    }
    this.fillLegend();
  }

  get lines() {
    return this.spec.choices ? this.spec.choices[this.choice].lines : this.spec.lines || [];
  }

  get limits() {
    return (this.spec.choices ? this.spec.choices[this.choice].limits : this.spec.limits) || [];
  }

  makeTop() {
    const top = document.createElement("div"), title = document.createElement("h3");
    top.className = "top";
    title.textContent = this.spec.title + (this.spec.unit ? `, ${this.spec.unit}` : "");
    top.append(title);
    if (this.spec.choices) {
      this.select = document.createElement("select");
      this.select.setAttribute("aria-label", `${this.spec.title}: which`);
      this.spec.choices.forEach((choice) => {
        const option = document.createElement("option");
        option.textContent = choice.label;
        this.select.append(option);
      });
      this.select.addEventListener("change", () => this.view.choose(this.spec, this.select.selectedIndex));
      top.append(this.select);
    }
    if (this.spec.note) {
      const note = document.createElement("span");
      note.className = "hint";
      note.textContent = this.spec.note;
      top.append(note);
    }
    return top;
  }

  choose(index) {
    this.choice = Math.min(index, this.spec.choices.length - 1);
    this.select.selectedIndex = this.choice;
    this.fillLegend();
  }

  fillLegend() {
    this.legend.replaceChildren();
    this.values = [];
    if (this.spec.kind === "bars") {
      for (const [name, colour] of Object.values(this.spec.codes)) {
        const key = document.createElement("span"), box = document.createElement("i");
        key.className = "key";
        box.style.color = `var(--${colour})`;
        key.append(box, name);
        this.legend.append(key);
      }
    }
    this.lines.forEach((line) => {
      const button = document.createElement("button"), box = document.createElement("i");
      const value = document.createElement("b");
      if (line.hidden && !this.met.has(line.label)) this.hidden.add(line.label);
      this.met.add(line.label);
      button.type = "button";
      button.setAttribute("aria-pressed", String(!this.hidden.has(line.label)));
      box.style.color = `var(--c${line.colour % 8})`;
      button.append(box, line.label, value);
      button.addEventListener("click", () => {
        if (!this.hidden.delete(line.label)) this.hidden.add(line.label);
        button.setAttribute("aria-pressed", String(!this.hidden.has(line.label)));
        this.view.redraw();
      });
      this.values.push(value);
      this.legend.append(button);
    });
    this.canvas.setAttribute("aria-label", this.inWords());
  }

  inWords() {
    if (this.spec.kind === "bars") {
      return `${this.spec.title}: ` + this.spec.rows.map((row) => `${row.label}, ${row.spans.length} stretches`).join("; ");
    }
    const ranges = this.lines.map((line) => {
      const signal = this.data.signals[line.signal];
      return `${line.label} from ${inWords(signal.lo)} to ${inWords(signal.hi)} ${this.spec.unit}`;
    });
    return `${this.spec.title}: ${ranges.join("; ")}`;
  }

  get height() {
    if (this.spec.kind !== "bars") return this.narrow ? 150 : this.first ? 210 : 170;
    return this.spec.rows.length * (this.narrow ? ROW_NARROW : ROW) + 24;
  }

  // The part of the canvas that holds the data; the same left and right in every panel.
  layout() {
    const width = this.canvas.clientWidth || 600;
    this.narrow = width < 560;
    this.box = {
      left: this.narrow ? 46 : 92, right: width - 10, top: this.first ? 31 : 6, bottom: this.height - 18,
    };
    this.width = width;
  }

  draw(theme) {
    this.layout();
    const ratio = window.devicePixelRatio || 1, { canvas, width, height, box } = this;
    canvas.style.height = `${height}px`;
    const pixels = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== pixels[0]) canvas.width = pixels[0];
    if (canvas.height !== pixels[1]) canvas.height = pixels[1];
    const ctx = canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    ctx.font = "11px system-ui, sans-serif";
    const { from, to } = this.view;
    const x = (t) => box.left + ((t - from) / (to - from)) * (box.right - box.left);
    this.timeAxis(ctx, theme, x);
    if (this.spec.kind === "bars") this.drawBars(ctx, theme, x);
    else this.drawLines(ctx, theme, x);
    this.drawMarks(ctx, theme, x);
    this.drawSelection(ctx, theme, x);
  }

  timeAxis(ctx, theme, x) {
    const { box } = this, { from, to } = this.view;
    const [values, digits] = ticks(from, to, (box.right - box.left) / 80);
    ctx.lineWidth = 1;
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    for (const t of values) {
      const px = Math.round(x(t)) + 0.5;
      ctx.strokeStyle = theme("--grid");
      line(ctx, px, box.top, px, box.bottom);
      ctx.fillStyle = theme("--muted");
      const half = ctx.measureText(inDigits(t, digits)).width / 2;
      ctx.fillText(inDigits(t, digits), Math.min(px, this.width - half), box.bottom + 4);
    }
  }

  range() {
    const { from, to } = this.view;
    let low = Infinity, high = -Infinity;
    const take = (value) => { low = Math.min(low, value); high = Math.max(high, value); };
    for (const one of this.lines) {
      if (this.hidden.has(one.label)) continue;
      const found = extentIn(this.data.signals[one.signal], from, to);
      if (found) found.forEach(take);
    }
    this.limits.filter((limit) => limit.shown).forEach((limit) => take(limit.value));
    if (this.spec.reach) high = Math.max(low, Math.min(high, this.spec.reach));
    if (low > high) return [0, 1];
    const least = Math.max(Math.abs(low), Math.abs(high)) * 1e-6 || 1e-6;
    const pad = Math.max((high - low) * 0.06, least);
    return [low - pad, high + pad];
  }

  drawLines(ctx, theme, x) {
    const { box } = this, { from, to } = this.view, [low, high] = this.range();
    const y = (value) => box.bottom - ((value - low) / (high - low)) * (box.bottom - box.top);
    const [values, digits] = ticks(low, high, (box.bottom - box.top) / 32);
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    for (const value of values) {
      const py = Math.round(y(value)) + 0.5;
      ctx.strokeStyle = theme("--grid");
      line(ctx, box.left, py, box.right, py);
      ctx.fillStyle = theme("--muted");
      ctx.fillText(inDigits(value, digits), box.left - 5, py);
    }
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    ctx.clip();
    this.limits.forEach((limit) => this.drawLimit(ctx, theme, y, limit));
    ctx.lineWidth = 1.3;
    for (const one of this.lines) {
      if (this.hidden.has(one.label)) continue;
      ctx.strokeStyle = theme(`--c${one.colour % 8}`);
      ctx.setLineDash(one.dashed ? [5, 3] : []);
      drawSignal(ctx, this.data.signals[one.signal], from, to, x, y);
    }
    ctx.setLineDash([]);
    ctx.restore();
  }

  drawLimit(ctx, theme, y, limit) {
    const { box } = this, py = Math.round(y(limit.value)) + 0.5;
    if (py < box.top || py > box.bottom) return;
    ctx.strokeStyle = ctx.fillStyle = theme("--bad");
    ctx.lineWidth = 1;
    ctx.setLineDash([2, 3]);
    line(ctx, box.left, py, box.right, py);
    ctx.setLineDash([]);
    ctx.textAlign = "right";
    ctx.textBaseline = py - box.top > 14 ? "bottom" : "top";
    ctx.fillText(limit.label, box.right - 2, py);
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
    const free = [-Infinity, -Infinity];  // two rows of names
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

  drawSelection(ctx, theme, x) {
    const { box } = this, { drag, cursor, from, to } = this.view;
    if (drag) {
      ctx.fillStyle = theme("--select");
      const a = Math.max(box.left, Math.min(x(drag[0]), x(drag[1])));
      const b = Math.min(box.right, Math.max(x(drag[0]), x(drag[1])));
      ctx.fillRect(a, box.top, b - a, box.bottom - box.top);
    }
    if (cursor !== null && cursor >= from && cursor <= to) {
      ctx.strokeStyle = theme("--fg");
      ctx.lineWidth = 1;
      const px = Math.round(x(cursor)) + 0.5;
      line(ctx, px, box.top, px, box.bottom);
    }
    this.readAt(cursor);
  }

  readAt(t) {
    this.lines.forEach((one, index) => {
      const value = t === null ? null : valueAt(this.data.signals[one.signal], t);
      this.values[index].textContent = inWords(value);
    });
    if (!this.read) return;
    const parts = t === null ? [] : this.spec.rows.map((row) => {
      const span = row.spans.find(([begin, end]) => begin <= t && t <= end);
      return `${row.label} ${span ? this.spec.codes[span[2]][0] : "silent"}`;
    });
    this.read.textContent = parts.join(" · ");
  }

  timeAt(px) {
    this.layout();
    const { left, right } = this.box, { from, to } = this.view;
    return Math.min(to, Math.max(from, from + ((px - left) / (right - left)) * (to - from)));
  }
}

function line(ctx, x0, y0, x1, y1) {
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
}
