"use strict";
// The report page: one uPlot for each panel; all share the time range and the cursor.

const data = JSON.parse(document.getElementById("data").textContent);
const [BEGIN, END] = data.span[1] > data.span[0] ? data.span : [data.span[0], data.span[0] + 1];
const MARK_COLOURS = {
  kill: "--bad", fall: "--bad", estop: "--bad", fault: "--warn", stall: "--warn",
  network: "--net", restart: "--good", push: "--muted",
};
const FONT = "11px system-ui, sans-serif", MARKS_ROOM = 44, BAR_HEIGHT = 18, PLOT_HEIGHT = 170;

const view = { from: BEGIN, to: END, panels: [], style: null };
const theme = (name) => view.style.getPropertyValue(name).trim();
const readTheme = () => { view.style = getComputedStyle(document.documentElement); };

function show(from, to) {
  const length = Math.min(END - BEGIN, Math.max(0.005, to - from));
  view.from = Math.min(END - length, Math.max(BEGIN, (from + to - length) / 2));
  view.to = view.from + length;
  for (const panel of view.panels) panel.resize();
}

// Shift the time range by a fraction of its length, and scale its length by a factor.
function move(fraction, factor = 1) {
  const length = view.to - view.from, middle = view.from + (0.5 + fraction) * length;
  show(middle - factor * length / 2, middle + factor * length / 2);
}

const fourDigits = (value) => String(Number(value.toPrecision(4)));

// Draw on a plot's canvas in CSS pixels. `paint` receives the context, the plot area, and a
// function that returns x at time t.
function paintOn(plot, paint) {
  const { ctx, bbox } = plot, ratio = ctx.canvas.width / plot.width;
  const [left, top] = [bbox.left / ratio, bbox.top / ratio];
  const box = { left, top, right: left + bbox.width / ratio, bottom: top + bbox.height / ratio };
  ctx.save();
  ctx.scale(ratio, ratio);
  ctx.font = FONT;
  ctx.textBaseline = "middle";
  ctx.lineWidth = 1;
  paint(ctx, box, (t) => left + plot.valToPos(t, "x"));
  ctx.restore();
}

function dashedLine(ctx, colour, dash, x0, y0, x1, y1) {
  ctx.strokeStyle = colour;
  ctx.setLineDash(dash);
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
  ctx.setLineDash([]);
}

// Draw each event as a vertical line. The first plot also shows the events' names, in up to three rows.
function paintMarks(plot, isFirst) {
  paintOn(plot, (ctx, box, x) => {
    const rowEnds = [-Infinity, -Infinity, -Infinity];
    for (const [t, kind, label] of data.marks) {
      if (t < view.from || t > view.to) continue;
      const colour = theme(MARK_COLOURS[kind] || "--muted"), px = Math.round(x(t)) + 0.5;
      dashedLine(ctx, colour, [4, 3], px, box.top, px, box.bottom);
      const width = ctx.measureText(label).width;
      const left = Math.min(Math.max(px - width / 2, box.left), box.right - width);
      const row = rowEnds.findIndex((end) => left >= end);
      if (!isFirst || row < 0) continue;
      ctx.fillStyle = colour;
      ctx.fillText(label, left, box.top - 9 - 13 * row);
      rowEnds[row] = left + width + 6;
    }
  });
}

// Draw each limit in view as a dotted line. A name that would overlap another is left out.
function paintLevels(plot, levels) {
  const { min, max } = plot.scales.y, placed = [];
  paintOn(plot, (ctx, box) => {
    for (const [value, label] of levels) {
      if (value < min || value > max) continue;
      const y = Math.round(box.top + plot.valToPos(value, "y")) + 0.5;
      dashedLine(ctx, theme("--bad"), [2, 3], box.left, y, box.right, y);
      const at = y - box.top > 14 ? y - 7 : y + 7;
      if (placed.some((other) => Math.abs(other - at) < 12)) continue;
      placed.push(at);
      ctx.textAlign = "right";
      ctx.fillStyle = theme("--bad");
      ctx.fillText(label, box.right - 2, at);
    }
  });
}

// Draw the rows of coloured bars. A bar shows its name if it is wide enough.
function paintBars(plot, rows) {
  paintOn(plot, (ctx, box, x) => {
    rows.forEach(([label, bars], number) => {
      const middle = box.top + (number + 0.5) * BAR_HEIGHT;
      ctx.fillStyle = theme("--fg");
      ctx.textAlign = "right";
      ctx.fillText(label, box.left - 5, middle);
      ctx.textAlign = "center";
      for (const [begin, end, name] of bars) {
        if (end < view.from || begin > view.to) continue;
        const left = Math.max(box.left, x(begin));
        const right = Math.min(box.right, Math.max(x(end), x(begin) + 1));
        ctx.fillStyle = theme(`--${data.colours[name] ?? "idle"}`);
        ctx.fillRect(left, middle - BAR_HEIGHT / 2 + 1, right - left, BAR_HEIGHT - 3);
        if (right - left <= ctx.measureText(name).width + 8) continue;
        ctx.fillStyle = theme(`--on-${data.colours[name] ?? "idle"}`);
        ctx.fillText(name, (left + right) / 2, middle);
      }
    });
  });
}

class Panel {
  constructor(spec, isFirst, parent) {
    Object.assign(this, { spec, isFirst, hasBars: spec.rows.length > 0 });
    const element = document.createElement("section"), { title, unit, note } = spec;
    element.className = this.hasBars ? "panel bars" : "panel";
    element.innerHTML = `<div class="top"><h3>${title}${unit ? `, ${unit}` : ""}</h3>
      <span class="hint">${note}</span></div><div class="stage"></div>`;
    this.stage = element.lastElementChild;
    parent.append(element);
    const times = Float64Array.from({ length: 2001 }, (_, n) => BEGIN + n * (END - BEGIN) / 2000);
    const columns = this.hasBars
      ? [times, ...spec.rows.map(() => new Array(times.length).fill(null))]
      : uPlot.join(spec.lines.map(({ t, v }) => [t, v]));
    this.plot = new uPlot(this.options(), columns, this.stage);
  }

  options() {
    const { spec } = this;
    return {
      ...this.size(),
      padding: [this.isFirst ? MARKS_ROOM : 6, 20, 0, this.hasBars ? 100 : 0],
      series: [{}, ...(this.hasBars ? spec.rows.map(barSeries) : spec.lines.map(lineSeries))],
      scales: {
        x: { time: false, min: view.from, max: view.to, range: (_, min, max) => [min, max] },
        y: { range: (_, low, high) => this.range(low, high) },
      },
      axes: this.axes(),
      legend: { markers: { width: 0, fill: (_, index) => this.marker(index) } },
      cursor: {
        y: false, sync: { key: "time", scales: ["x", null] }, drag: { setScale: false, dist: 4 },
        points: this.hasBars ? { show: false } : { size: 7 },
        bind: { dblclick: () => () => show(BEGIN, END) },
      },
      hooks: {
        drawAxes: [(plot) => paintLevels(plot, spec.levels)],
        draw: [(plot) => {
          if (this.hasBars) paintBars(plot, spec.rows);
          paintMarks(plot, this.isFirst);
        }],
        setCursor: [({ cursor, posToVal }) => {
          const text = cursor.left < 0 ? "" : `t = ${posToVal(cursor.left, "x").toFixed(3)} s`;
          document.getElementById("cursor").textContent = text;
        }],
        setSelect: [({ cursor, select, posToVal }) => {
          if (!cursor.event || !select.width) return;  // only the plot in which the user dragged
          const ends = [select.left, select.left + select.width].map((px) => posToVal(px, "x"));
          queueMicrotask(() => show(...ends));  // after uPlot has updated the other plots
        }],
      },
    };
  }

  axes() {
    const common = {
      stroke: () => theme("--muted"), font: FONT, ticks: { show: false },
      grid: { stroke: () => theme("--grid"), width: 1 },
    };
    const values = (_, splits) => splits.map((t) => `${fourDigits(t)} s`);
    return [
      { ...common, size: 18, gap: 4, space: 64, values },
      { ...common, show: !this.hasBars, size: 100, space: 28 },
    ];
  }

  marker(index) {
    if (this.hasBars) return "none";
    const { colour, dashed } = this.spec.lines[index - 1], ink = `var(--c${colour % 8})`;
    return dashed ? `linear-gradient(90deg, ${ink} 40%, transparent 40% 60%, ${ink} 60%)` : ink;
  }

  // Return the range of the value axis for the smallest and largest values in view.
  range(low, high) {
    if (low === null) [low, high] = [Infinity, -Infinity];
    for (const [value, , shown] of this.spec.levels) {
      if (shown) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (low > high) return [0, 1];
    if (this.spec.reach) high = Math.max(low, Math.min(high, this.spec.reach));
    const size = Math.max(Math.abs(low), Math.abs(high));
    const least = Math.max(1e-3, size * 1e-4);  // smaller differences are rounding errors
    const pad = Math.max((high - low) * 0.06, (least - (high - low)) / 2);
    return [low - pad, high + pad];
  }

  size() {
    const rows = this.spec.rows.length * BAR_HEIGHT + 24;
    const height = this.hasBars ? rows : PLOT_HEIGHT;
    return { width: this.stage.clientWidth || 600, height: height + (this.isFirst ? MARKS_ROOM : 0) };
  }

  resize() {
    const { plot } = this, size = this.size();
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    plot.batch(() => {
      if (size.width !== plot.width) plot.setSize(size);
      plot.setScale("x", { min: view.from, max: view.to });
    });
  }
}

function lineSeries({ label, colour, dashed, hidden }) {
  return {
    label, stroke: () => theme(`--c${colour % 8}`), width: 1.3, dash: dashed ? [5, 3] : undefined,
    show: !hidden, points: { size: 4 },
    value: (_, value) => (value === null || value === undefined ? "" : fourDigits(value)),
  };
}

function barSeries([label, bars]) {
  return {
    label, paths: () => null, points: { show: false },
    value: ({ cursor, posToVal }, value, series, place) => {
      if (place === null) return "";
      const t = posToVal(cursor.left, "x");
      return bars.find(([begin, end]) => begin <= t && t <= end)?.[2] ?? "silent";
    },
  };
}

function listenToPage() {
  const moves = {
    left: () => move(-0.5), right: () => move(0.5), in: () => move(0, 0.5), out: () => move(0, 2),
    all: () => show(BEGIN, END),
  };
  for (const button of document.querySelectorAll("[data-do]")) {
    button.addEventListener("click", moves[button.dataset.do]);
  }
  const rows = [...document.querySelectorAll("[data-t]")];
  for (const row of rows) {
    row.addEventListener("click", () => {
      const t = Number(row.dataset.t), before = Number(row.dataset.before);
      show(t - before, t - before + Math.max(2, before + 0.5));
      rows.forEach((other) => other.setAttribute("aria-current", String(other === row)));
      if (!view.panels.length) return;
      const { plot } = view.panels[0];
      plot.setCursor({ left: plot.valToPos(t, "x"), top: 0 }, true, true);
      view.panels[0].stage.scrollIntoView({ block: "nearest" });
    });
  }
  const renew = () => { readTheme(); show(view.from, view.to); };
  window.addEventListener("resize", renew);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", renew);
}

readTheme();
data.panels.forEach((spec, index) => {
  view.panels.push(new Panel(spec, index === 0, document.getElementById("panels")));
});
listenToPage();
