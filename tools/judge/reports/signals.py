"""Signals for the plots of a page: downsampled to an even grid with every extreme kept. Pure.

A signal is divided into bins of equal width. Each bin keeps its least and its greatest value, in
the order in which they came. So a plot shows every extreme at each zoom, and the size of a page
does not grow with the length of the run.
"""

from __future__ import annotations

import base64
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.arrays import Array
from shared.clock import NS_PER_S

BINS: Final = 4500
"""Bins over the whole run: 13 ms each in a run of a minute. A bin has two places: for two
extremes, or for one sample in the half of the bin in which it was taken."""
BIN_MIN_S: Final = 0.002
GAP_S: Final = 0.1
"""A plot interrupts its line where a signal has no sample for longer than this."""

SKIP: Final = -32768
"""Code of a place without a sample: the line passes."""
BREAK: Final = -32767
"""Code of a place without a sample: the line is interrupted."""
FIRST: Final = -32766
"""Code of the signal's least value."""
STEPS: Final = 32767 - FIRST


class Span(NamedTuple):
    """Time that a page shows, s."""

    begin: float
    end: float

    @property
    def bin_s(self) -> float:
        """Width of a bin."""
        return max((self.end - self.begin) / BINS, BIN_MIN_S)

    @property
    def grid(self) -> dict[str, float]:
        """Times of all signals: one in the middle of each half bin."""
        count = 2 * (int((self.end - self.begin) / self.bin_s) + 1)
        return {"begin": self.begin, "step": self.bin_s / 2, "count": count}


def message_times(
    stamps_ns: list[int], zero_ns: int, received_ns: list[int] | None = None
) -> Array:
    """Return the times of messages in s, which never fall.

    A joint service whose drive is silent repeats the stamp of its last sample. Messages with
    equal stamps are placed after the first by their delay of reception, but before the next
    stamp. Messages received at the same time (all, in virtual time) are spread until the next
    stamp, at half the usual rate or faster.
    """
    stamps = np.maximum.accumulate(np.array(stamps_ns, dtype=np.int64))
    t = (stamps - zero_ns) / NS_PER_S
    if not len(t) or np.diff(stamps).all():
        return t
    starts = np.flatnonzero(np.concatenate(([True], np.diff(stamps) > 0)))
    counts = np.diff(np.append(starts, len(t)))
    room = np.repeat(counts, counts)
    within = np.arange(len(t)) - np.repeat(starts, counts)
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0.0])) if steps.any() else 0.0
    until = np.repeat(np.append(t[starts[1:]], np.inf), counts)
    later = within * usual * np.where(np.isfinite(until), 2.0, 1.0)
    if received_ns is not None:
        received = np.maximum.accumulate(np.array(received_ns, dtype=np.int64))
        delay = (received - np.repeat(received[starts], counts)) / NS_PER_S
        is_known = np.repeat(np.maximum.reduceat(delay, starts) > 0.0, counts)
        later = np.where(is_known, delay, later)
    latest = t + (until - t) * (within + 1) / (room + 1)
    return np.asarray(np.minimum(t + later, np.where(within > 0, latest, t)), dtype=np.float64)


def encode_signal(t: Array, values: Array, span: Span) -> dict[str, Any] | None:
    """Return a signal as the page stores it, or None if it has no finite value.

    The times `t`, s, do not fall; a value is NaN where there is none.
    """
    usable = np.isfinite(values) & (t >= span.begin) & (t <= span.end)
    t, values = t[usable], values[usable]
    if not len(t):
        return None
    width = span.bin_s
    position = (t - span.begin) / width
    bins = position.astype(np.int64)
    starts = np.flatnonzero(np.concatenate(([True], np.diff(bins) > 0)))
    first, second = _extremes(values, starts)
    lo, hi = float(values.min()), float(values.max())
    step = (hi - lo) / STEPS
    codes = np.full((int(bins[-1] - bins[0]) + 1, 2), SKIP, dtype=np.int16)
    for column, extremes in enumerate((first, second)):
        scaled = np.rint((extremes - lo) / step) if step > 0.0 else np.zeros(len(extremes))
        coded = np.clip(scaled, 0, STEPS).astype(np.int64) + FIRST
        codes[bins[starts] - bins[0], column] = coded
    alone = starts[np.diff(np.append(starts, len(t))) == 1]
    second_half = (position[alone] - bins[alone] >= 0.5).astype(np.int64)
    codes[bins[alone] - bins[0], 1 - second_half] = SKIP  # one sample is one point
    places = codes.reshape(-1)
    used = np.flatnonzero(places != SKIP)
    for gap in np.flatnonzero(np.diff(t) > _gap(t)):
        last, following = np.searchsorted(used, 2 * (bins[[gap, gap + 1]] - bins[0] + [1, 0]))
        places[used[last - 1] + 1 : used[following]] = BREAK
    return {
        "first": 2 * int(bins[0]),
        "lo": lo,
        "hi": hi,
        "step": step,
        "d": base64.b64encode(codes.astype("<i2").tobytes()).decode(),
    }


def thinned(t: Array, values: Array, span: Span) -> tuple[Array, Array]:
    """Return the samples of each bin that `encode_signal` needs: its extremes, first and last."""
    usable = np.isfinite(values)
    t, values = t[usable], values[usable]
    if not len(t):
        return t, values
    bins = ((t - span.begin) / span.bin_s).astype(np.int64)
    starts = np.flatnonzero(np.concatenate(([True], np.diff(bins) > 0)))
    by_value = np.lexsort((values, bins))
    ends = np.append(starts[1:], len(t)) - 1
    kept = np.unique(np.concatenate((starts, ends, by_value[starts], by_value[ends])))
    return t[kept], values[kept]


def _gap(t: Array) -> float:
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    return max(GAP_S, 5.0 * usual)


def _extremes(values: Array, starts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the two extremes of each bin in the order in which they came."""
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    counts = np.diff(np.append(starts, len(values)))
    places = np.arange(len(values))
    beyond = len(values)
    at_low = np.where(values == np.repeat(low, counts), places, beyond)
    at_high = np.where(values == np.repeat(high, counts), places, beyond)
    rising = np.minimum.reduceat(at_low, starts) <= np.minimum.reduceat(at_high, starts)
    return np.where(rising, low, high), np.where(rising, high, low)


def segments(t: Array, codes: NDArray[np.int64], gap_s: float = GAP_S) -> list[list[float]]:
    """Return [begin, end, code] of every interval with one code; a gap ends an interval."""
    if not len(t):
        return []
    changed = (np.diff(codes) != 0) | (np.diff(t) > gap_s)
    starts = np.flatnonzero(np.concatenate(([True], changed)))
    found: list[list[float]] = []
    for start, following in zip(starts, np.append(starts[1:], len(t)), strict=True):
        end = t[following - 1]
        if following < len(t) and t[following] - end <= gap_s:
            end = t[following]
        found.append([round(float(t[start]), 4), round(float(end), 4), int(codes[start])])
    return found
