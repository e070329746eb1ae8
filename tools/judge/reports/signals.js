"use strict";
// Signals as uPlot takes them: one array of values each, all on one grid of times.
// tools/judge/reports/signals.py describes the codes.

const SKIP = -32768, BREAK = -32767, FIRST = -32766;

function gridTimes({ begin, step, count }) {
  return Float64Array.from({ length: count }, (_, place) => begin + (place + 0.5) * step);
}

// Add to a signal its values on the grid: null interrupts the line, undefined lets it pass.
// Also add its lone samples, between two interruptions, where no line passes.
function decode(signal, count) {
  if (signal.values) return signal;
  const bytes = Uint8Array.from(atob(signal.d), (character) => character.charCodeAt(0));
  const codes = new DataView(bytes.buffer), values = new Array(count).fill(null);
  for (let i = 0; i < bytes.length / 2; i++) {
    const code = codes.getInt16(2 * i, true);
    if (code === BREAK) continue;
    values[signal.first + i] = code === SKIP ? undefined : signal.lo + (code - FIRST) * signal.step;
  }
  const known = [...values.keys()].filter((place) => values[place] !== undefined);
  const isGap = (place) => place === undefined || values[place] === null;
  const lone = known.filter((place, i) => !isGap(place) && isGap(known[i - 1]) && isGap(known[i + 1]));
  return Object.assign(signal, { d: "", values, lone: lone.length ? lone : null });
}
