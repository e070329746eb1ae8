// One panel: a title, and a uPlot with its legend. All panels share the view's time.

// Smallest range of the value axis: smaller changes are rounding.
const RANGE_MIN = {
  mm: 0.01, m: 1e-5, rad: 1e-5, "rad/s": 1e-4, N: 0.01, "N m": 0.01, ms: 0.01, "\u00b5s": 1, Hz: 1, count: 1,
};
const NO_SELECTION = { left: 0, top: 0, width: 0, height: 0 };

class Panel {
  constructor(spec, data, view, first) {
    Object.assign(this, { spec, data, view, first, choice: spec.initial || 0, hidden: new Map() });
    this.bars = spec.kind === "bars";
    this.element = make("section", this.bars ? "panel bars" : "panel");
    this.stage = make("div", "stage");
    this.element.append(this.heading(), this.stage);
  }

  get shown() { return this.spec.choices ? this.spec.choices[this.choice] : this.spec; }

  get lines() { return this.shown.lines || []; }

  get limits() { return this.shown.limits || []; }

  heading() {
    const { spec } = this, top = make("div", "top");
    top.append(make("h3", "", spec.title + (spec.unit ? `, ${spec.unit}` : "")));
    if (spec.choices) {
      this.select = make("select");
      this.select.setAttribute("aria-label", `${spec.title}: which`);
      spec.choices.forEach((choice) => this.select.append(make("option", "", choice.label)));
      this.select.addEventListener("change", () => this.view.choose(spec, this.select.selectedIndex));
      top.append(this.select);
    }
    if (spec.note) top.append(make("span", "hint", spec.note));
    for (const [name, colour] of this.bars ? Object.values(spec.codes) : []) {
      const key = make("span", "key"), swatch = make("i");
      swatch.style.color = `var(--${colour})`;
      key.append(swatch, name);
      top.append(key);
    }
    return top;
  }

  choose(index) {
    this.choice = Math.min(index, this.spec.choices.length - 1);
    this.build();
  }

  // Make the plot. A choice has its own lines, so it gets a new plot; hidden lines stay hidden.
  build() {
    if (this.select) this.select.selectedIndex = this.choice;
    if (this.plot) this.plot.destroy();
    const { times } = this.data, count = times.length;
    const none = new Array(this.bars ? count : 0).fill(null);
    const columns = this.bars
      ? this.spec.rows.map(() => none)
      : this.lines.map(({ signal }) => decode(this.data.signals[signal], count).values);
    this.plot = new uPlot(this.options(), [times, ...columns], this.stage);
    this.pin = make("div", "pin");
    this.plot.over.append(this.pin);
    this.plot.over.tabIndex = 0;
    this.plot.over.setAttribute("role", "img");
    this.plot.over.setAttribute("aria-label", this.description());
    listenToPlot(this);
    if (!this.bars) this.listenToLegend();
    this.placePin();
  }

  options() {
    const { view } = this;
    return {
      ...this.size(),
      padding: [this.first ? MARKS_ROOM : 6, () => (this.narrow ? 12 : 20), 0, () => (this.bars ? this.left : 0)],
      series: [{}, ...(this.bars ? this.spec.rows.map((row) => this.barSeries(row)) : this.lines.map((line) => this.lineSeries(line)))],
      scales: {
        x: { time: false, min: view.from, max: view.to, range: (_, min, max) => [min, max] },
        y: { range: (_, low, high) => this.range(low, high) },
      },
      axes: this.axes(),
      legend: { markers: { width: 0, fill: (_, index) => this.marker(index) } },
      cursor: {
        y: false,
        sync: { key: "time", scales: ["x", null] },
        drag: { setScale: false, dist: 4 },
        points: this.bars ? { show: false } : { size: 7, fill: (_, index) => this.colour(index) },
        bind: { dblclick: () => () => view.all() },
      },
      hooks: this.hooks(),
    };
  }

  axes() {
    const { view } = this;
    const common = {
      stroke: () => view.theme("--muted"), font: FONT, ticks: { show: false },
      grid: { stroke: () => view.theme("--grid"), width: 1 },
    };
    const time = {
      ...common, size: 18, gap: 4, space: 64,
      values: (plot, splits, axis, space, step) => axisTexts(splits, step).map((text, i) => {
        const right = this.left + plot.valToPos(splits[i], "x") + 3.5 * text.length + 5;
        return right < plot.width ? `${text} s` : null;  // no half label at the edge
      }),
    };
    const value = {
      ...common, show: !this.bars, size: () => this.left, space: 28,
      values: (_, splits, axis, space, step) => axisTexts(splits, step),
    };
    return [time, value];
  }

  lineSeries({ label, signal, colour, dashed, hidden }) {
    const { lone } = this.data.signals[signal];
    const stroke = () => this.view.theme(`--c${colour % 8}`);
    return {
      label, stroke, width: 1.3, dash: dashed ? [5, 3] : undefined,
      show: !(this.hidden.has(label) ? this.hidden.get(label) : hidden),
      value: (_, value) => fourDigits(value),
      points: { size: 4, width: 0, fill: stroke, filter: (plot, series, all) => (all ? null : lone) },
    };
  }

  barSeries({ label, spans }) {
    const name = (t) => {
      const span = spans.find(([begin, end]) => begin <= t && t <= end);
      return span ? this.spec.codes[span[2]][0] : "silent";
    };
    return {
      label, paths: () => null, points: { show: false },
      value: (plot, value, series, place) => (place === null ? "" : name(plot.posToVal(plot.cursor.left, "x"))),
    };
  }

  colour(index) { return `var(--c${this.lines[index - 1].colour % 8})`; }

  marker(index) {
    if (this.bars) return "none";
    const colour = this.colour(index);
    if (!this.lines[index - 1].dashed) return colour;
    return `linear-gradient(90deg, ${colour} 40%, transparent 40% 60%, ${colour} 60%)`;
  }

  hooks() {
    const { view } = this;
    return {
      drawAxes: [(plot) => paintLimits(plot, this)],
      draw: [(plot) => {
        if (this.bars) paintBars(plot, this);
        else nameLimits(plot, this);
        paintMarks(plot, this);
        this.placePin();
      }],
      setCursor: [({ cursor, posToVal }) => view.read(cursor.left < 0 ? null : posToVal(cursor.left, "x"))],
      setSelect: [({ cursor, select, posToVal }) => {
        if (!cursor.event || !select.width) return;  // only the plot that was dragged in
        const [from, to] = [select.left, select.left + select.width].map((px) => posToVal(px, "x"));
        queueMicrotask(() => view.show(from, to));  // when uPlot is done with the other plots
      }],
      setSeries: [(plot, index, { show }) => { if (show !== undefined) this.toggled(); }],
    };
  }

  // Range of the value axis, from the least and the greatest value in view.
  range(low, high) {
    if (low === null) [low, high] = [Infinity, -Infinity];
    for (const { value, shown } of this.limits) {
      if (shown) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (low > high) return [0, 1];
    if (this.spec.reach) high = Math.max(low, Math.min(high, this.spec.reach));
    const least = Math.max(RANGE_MIN[this.spec.unit] || 1e-3, Math.max(Math.abs(low), Math.abs(high)) * 1e-4);
    const pad = Math.max((high - low) * 0.06, (least - (high - low)) / 2);
    return [low - pad, high + pad];
  }

  size() {
    const width = this.stage.clientWidth || 600;
    this.narrow = width < 560;
    this.left = this.narrow ? 54 : 100;
    const rows = this.bars ? this.spec.rows.length * (this.narrow ? ROW_NARROW : ROW) + 24 : 0;
    return { width, height: rows || (this.narrow ? 150 : 170) + (this.first ? MARKS_ROOM : 0) };
  }

  update() {
    const { width, height } = this.plot, size = this.size();
    this.plot.batch(() => {
      if (size.width !== width || size.height !== height) this.plot.setSize(size);
      this.plot.setScale("x", { min: this.view.from, max: this.view.to });
    });
  }

  placePin() {
    const { pin, from, to } = this.view;
    const seen = pin !== null && pin >= from && pin <= to;
    this.pin.hidden = !seen;
    if (seen) this.pin.style.left = `${this.plot.valToPos(pin, "x")}px`;
  }

  // uPlot's legend reacts to clicks alone; keys and screen readers get the same.
  listenToLegend() {
    this.names = [...this.plot.root.querySelectorAll(".u-series th")].slice(1);
    for (const name of this.names) {
      name.tabIndex = 0;
      name.setAttribute("role", "button");
      name.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        name.click();
      });
    }
    this.toggled();
  }

  toggled() {
    this.plot.series.slice(1).forEach((series, index) => {
      this.hidden.set(series.label, !series.show);
      this.names[index].setAttribute("aria-pressed", String(series.show));
    });
  }

  description() {
    const parts = this.bars
      ? this.spec.rows.map((row) => `${row.label}, ${row.spans.length} intervals`)
      : this.lines.map(({ label, signal }) => {
        const { lo, hi } = this.data.signals[signal];
        return `${label} from ${fourDigits(lo)} to ${fourDigits(hi)} ${this.spec.unit}`;
      });
    return `${this.spec.title}: ${parts.join("; ")}`;
  }
}
