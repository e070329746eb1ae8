// What uPlot does not draw: event marks, limits, state bars. All in CSS pixels.

const MARK_COLOURS = {
  kill: "--bad", fall: "--bad", estop: "--bad", fault: "--warn", stall: "--warn", network: "--warn", restart: "--good", push: "--muted",
};
const MARKS_ROOM = 44, ROW = 18, ROW_NARROW = 30;

// Draw on a plot's canvas. `paint` gets the context, the plot area, and the x of a time.
function paintOn(plot, paint) {
  const { ctx, bbox } = plot, ratio = ctx.canvas.width / plot.width;
  const box = {
    left: bbox.left / ratio, top: bbox.top / ratio,
    right: (bbox.left + bbox.width) / ratio, bottom: (bbox.top + bbox.height) / ratio,
  };
  ctx.save();
  ctx.scale(ratio, ratio);
  ctx.font = FONT;
  ctx.textBaseline = "middle";
  paint(ctx, box, (t) => box.left + plot.valToPos(t, "x"));
  ctx.restore();
}

function dashedLine(ctx, colour, dash, x0, y0, x1, y1) {
  ctx.strokeStyle = colour;
  ctx.lineWidth = 1;
  ctx.setLineDash(dash);
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
}

// Event marks: a line in every plot; in the first one also the names, in up to three rows.
function paintMarks(plot, { view, first }) {
  paintOn(plot, (ctx, box, x) => {
    const rowEnds = [-Infinity, -Infinity, -Infinity];
    for (const [t, kind, label] of view.marks) {
      if (t < view.from || t > view.to) continue;
      const colour = view.theme(MARK_COLOURS[kind] || "--muted"), px = Math.round(x(t)) + 0.5;
      dashedLine(ctx, colour, [4, 3], px, box.top, px, box.bottom);
      const width = ctx.measureText(label).width;
      const left = Math.min(Math.max(px - width / 2, box.left), box.right - width);
      const row = rowEnds.findIndex((end) => left >= end);
      if (!first || row < 0) continue;
      ctx.textAlign = "left";
      ctx.fillStyle = colour;
      ctx.fillText(label, left, box.top - 9 - 13 * row);
      rowEnds[row] = left + width + 6;
    }
  });
}

// The limits within the plot, as [y, name].
function limitsInPlot(plot, { limits }) {
  const { min, max } = plot.scales.y;
  return limits.filter(({ value }) => value >= min && value <= max)
    .map(({ value, label }) => [Math.round(plot.valToPos(value, "y")) + 0.5, label]);
}

function paintLimits(plot, panel) {
  paintOn(plot, (ctx, box) => {
    for (const [y] of limitsInPlot(plot, panel)) {
      dashedLine(ctx, panel.view.theme("--bad"), [2, 3], box.left, box.top + y, box.right, box.top + y);
    }
  });
}

// Names of limits, over the lines. Close ones stand side by side; equal ones stand once.
function nameLimits(plot, panel) {
  paintOn(plot, (ctx, box) => {
    const placed = [];
    ctx.textAlign = "right";
    ctx.lineJoin = "round";
    ctx.lineWidth = 3;
    ctx.strokeStyle = panel.view.theme("--bg");
    ctx.fillStyle = panel.view.theme("--bad");
    for (const [y, label] of limitsInPlot(plot, panel)) {
      const at = box.top + y + (y > 14 ? -7 : 7);
      const beside = placed.filter((other) => Math.abs(other.at - at) < 15);
      if (beside.some((other) => other.label === label)) continue;
      const right = Math.min(box.right - 2, ...beside.map((other) => other.left - 8));
      const left = right - ctx.measureText(label).width;
      if (left < box.left) continue;
      placed.push({ at, left, label });
      ctx.strokeText(label, right, at);
      ctx.fillText(label, right, at);
    }
  });
}

// One row of coloured bars for each module; the state's name where it fits.
function paintBars(plot, { spec, view, narrow }) {
  paintOn(plot, (ctx, box, x) => {
    const height = narrow ? ROW_NARROW : ROW, labelHeight = narrow ? 12 : 0;
    spec.rows.forEach(({ label, spans }, number) => {
      const top = box.top + number * height;
      ctx.fillStyle = view.theme("--fg");
      ctx.textAlign = narrow ? "left" : "right";
      if (narrow) ctx.fillText(label, box.left, top + 6);
      else ctx.fillText(label, box.left - 5, top + height / 2);
      ctx.textAlign = "center";
      for (const [begin, end, code] of spans) {
        if (end < view.from || begin > view.to) continue;
        const left = Math.max(box.left, x(begin));
        const right = Math.min(box.right, Math.max(x(end), x(begin) + 1));
        const [name, colour] = spec.codes[code];
        ctx.fillStyle = view.theme(`--${colour}`);
        ctx.fillRect(left, top + labelHeight + 1, right - left, height - labelHeight - 3);
        if (right - left <= ctx.measureText(name).width + 8) continue;
        ctx.fillStyle = view.theme(`--on-${colour}`);
        ctx.fillText(name, (left + right) / 2, top + labelHeight + (height - labelHeight) / 2);
      }
    });
  });
}
