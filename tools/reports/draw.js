"use strict";
// Signals and axes: no page, no events. A signal is a string of codes on an even grid
// (tools/reports/signals.py): two for each bin, its extremes in the order in which they came.

const SKIP = -32768, BREAK = -32767, FIRST = -32766;

function codesOf(signal) {
  if (!signal.codes) {
    const raw = atob(signal.d), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    const view = new DataView(bytes.buffer);
    signal.codes = new Int16Array(raw.length / 2);
    for (let i = 0; i < signal.codes.length; i++) signal.codes[i] = view.getInt16(2 * i, true);
    signal.d = "";
  }
  return signal.codes;
}

const timeOf = (signal, k) => signal.t0 + (k + 0.5) * signal.h;
const valueOf = (signal, code) => signal.lo + (code - FIRST) * signal.step;

// First and last place of a signal within a time, one more on each side.
function placesIn(signal, from, to) {
  const n = codesOf(signal).length;
  const first = Math.floor((from - signal.t0) / signal.h - 0.5);
  const last = Math.ceil((to - signal.t0) / signal.h - 0.5);
  return [Math.max(0, Math.min(n, first)), Math.max(-1, Math.min(n - 1, last))];
}

// [least, greatest] value within a time, or null.
function extentIn(signal, from, to) {
  const codes = codesOf(signal), [a, b] = placesIn(signal, from, to);
  let low = 40000, high = -40000;
  for (let k = a; k <= b; k++) {
    const code = codes[k];
    if (code < FIRST) continue;
    const t = timeOf(signal, k);
    if (t < from - signal.h || t > to + signal.h) continue;
    if (code < low) low = code;
    if (code > high) high = code;
  }
  return high < low ? null : [valueOf(signal, low), valueOf(signal, high)];
}

// Value nearest to a time, or null where the line is interrupted.
function valueAt(signal, t) {
  const codes = codesOf(signal), n = codes.length;
  const at = Math.round((t - signal.t0) / signal.h - 0.5);
  if (at < -2 || at > n + 1) return null;
  const search = (step) => {
    for (let k = Math.max(0, Math.min(n - 1, at)), i = 0; k >= 0 && k < n && i < 400; k += step, i++) {
      if (codes[k] === BREAK) return null;
      if (codes[k] >= FIRST) return [i, valueOf(signal, codes[k])];
    }
    return null;
  };
  const back = search(-1), on = search(1);
  if (!back || !on) return null;
  return back[0] <= on[0] ? back[1] : on[1];
}

// Draw a signal; where many samples share a column of pixels, their extremes are drawn.
function drawSignal(ctx, signal, from, to, x, y) {
  const codes = codesOf(signal), [a, b] = placesIn(signal, from, to);
  let column = null, low = 0, high = 0, last = 0, open = false;
  const flush = () => {
    if (column === null) return;
    if (high > low) {
      ctx.lineTo(column, y(valueOf(signal, low)));
      ctx.lineTo(column, y(valueOf(signal, high)));
    }
    ctx.lineTo(column, y(valueOf(signal, last)));
    column = null;
  };
  ctx.beginPath();
  for (let k = a; k <= b; k++) {
    const code = codes[k];
    if (code === SKIP) continue;
    if (code === BREAK) { flush(); open = false; continue; }
    const px = Math.round(x(timeOf(signal, k)) * 2) / 2;
    if (column !== px) {
      flush();
      const py = y(valueOf(signal, code));
      if (open) ctx.lineTo(px, py); else { ctx.moveTo(px, py); ctx.lineTo(px + 0.5, py); }
      open = true; column = px; low = high = code;
    }
    if (code < low) low = code;
    if (code > high) high = code;
    last = code;
  }
  flush();
  ctx.stroke();
}

// Round numbers that cover a range: [values, digits behind the point].
function ticks(low, high, most) {
  const raw = (high - low) / Math.max(1, most);
  if (!(raw > 0) || !isFinite(raw)) return [[low], 3];
  const power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) values.push(i * step);
  return [values, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}

function inDigits(value, digits) {
  const text = value.toFixed(Math.min(digits, 12));
  return /^-0\.?0*$/.test(text) ? text.slice(1) : text;
}

// A value for reading: four significant digits.
function inWords(value) {
  if (value === null) return "";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(2);
  return inDigits(value, size >= 1000 ? 0 : size >= 100 ? 1 : size >= 10 ? 2 : size >= 1 ? 3 : 4);
}

// A number of an axis as a power of ten, with the digits in which it differs from the others.
function inPowers(value, values) {
  if (value === 0 || values.length < 2) return value === 0 ? "0" : value.toPrecision(2);
  const digits = Math.ceil(Math.log10(Math.abs(value / (values[1] - values[0]))) - 1e-9);
  return value.toExponential(Math.min(5, Math.max(0, digits)));
}

function line(ctx, x0, y0, x1, y1) {
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
}

// Text that can be read over lines.
function haloed(ctx, theme, text, x, y, colour) {
  ctx.lineWidth = 3;
  ctx.lineJoin = "round";
  ctx.strokeStyle = theme("--bg");
  ctx.strokeText(text, x, y);
  ctx.fillStyle = theme(colour);
  ctx.fillText(text, x, y);
}
