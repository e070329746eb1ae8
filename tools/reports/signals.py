"""Signals for the plots of a page: on an even grid, with every extreme kept. Pure.

A signal is cut into bins of one width. Of each bin its least and its greatest value are
kept, in the order in which they came: zoomed in or out, a plot shows what was there, and
a page's size does not grow with the length of the run.
"""

from __future__ import annotations

import base64
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.clock import NS_PER_S

Array = NDArray[np.float64]

BINS: Final = 4500
"""Of each signal, over the whole run: 13 ms in a run of a minute. A bin has two places: two
extremes, or one sample in that half of the bin in which it was taken."""
BIN_MIN_S: Final = 0.002
GAP_S: Final = 0.1
"""A signal that is silent for longer is interrupted in the plot."""

SKIP: Final = -32768
"""Code of a bin without a sample: the line goes on."""
BREAK: Final = -32767
"""Code of a bin without a sample: the line is interrupted."""
FIRST: Final = -32766
"""Code of the least value."""
STEPS: Final = 32767 - FIRST


class Span(NamedTuple):
    """The time that a page shows, s."""

    begin: float
    end: float

    @property
    def bin_s(self) -> float:
        """Width of a bin."""
        return max((self.end - self.begin) / BINS, BIN_MIN_S)

    @property
    def grid(self) -> dict[str, float]:
        """Grid of times of all signals: half a bin apart, each in the middle of its half."""
        count = 2 * (int((self.end - self.begin) / self.bin_s) + 1)
        return {"begin": self.begin, "step": self.bin_s / 2, "count": count}


def seconds(stamps_ns: list[int], zero_ns: int, heard_ns: list[int] | None = None) -> Array:
    """Return times in s that rise.

    A joint service whose drive is silent goes on saying when its last sample came: messages
    with the same stamp come as far after the first as they were heard after it, but before
    the next stamp. Those that were heard at once (in virtual time, all) are spread until then,
    at half the usual rate or faster.

    Args:
        stamps_ns: of messages, in the order in which they came.
        zero_ns: time zero.
        heard_ns: when each message was heard, by another clock perhaps; None: the stamps are
            these times.
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
    if heard_ns is not None:
        heard = np.maximum.accumulate(np.array(heard_ns, dtype=np.int64))
        after = (heard - np.repeat(heard[starts], counts)) / NS_PER_S
        told = np.repeat(np.maximum.reduceat(after, starts) > 0.0, counts)
        later = np.where(told, after, later)
    latest = t + (until - t) * (within + 1) / (room + 1)
    return np.asarray(np.minimum(t + later, np.where(within > 0, latest, t)), dtype=np.float64)


def encode_signal(t: Array, values: Array, span: Span) -> dict[str, Any] | None:
    """Return a signal as it goes into the page, or None if it has no finite value.

    Args:
        t: times, s, not falling.
        values: one for each time; NaN where there is none.
        span: what the page shows.
    """
    good = np.isfinite(values) & (t >= span.begin) & (t <= span.end)
    t, values = t[good], values[good]
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
    late = (position[alone] - bins[alone] >= 0.5).astype(np.int64)
    codes[bins[alone] - bins[0], 1 - late] = SKIP  # one sample is one point, in its own half
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


def _gap(t: Array) -> float:
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    return max(GAP_S, 5.0 * usual)


def _extremes(values: Array, starts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the two extremes of each bin, that which came first before the other."""
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    counts = np.diff(np.append(starts, len(values)))
    places = np.arange(len(values))
    beyond = len(values)
    at_low = np.where(values == np.repeat(low, counts), places, beyond)
    at_high = np.where(values == np.repeat(high, counts), places, beyond)
    rising = np.minimum.reduceat(at_low, starts) <= np.minimum.reduceat(at_high, starts)
    return np.where(rising, low, high), np.where(rising, high, low)


def segments(t: Array, codes: NDArray[np.int64], gap_s: float = GAP_S) -> list[list[float]]:
    """Return [begin, end, code] of every stretch with one code; silence ends a stretch."""
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
