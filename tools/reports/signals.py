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
"""Of each signal, over the whole run: 13 ms in a run of a minute."""
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


def seconds(stamps_ns: list[int], zero_ns: int) -> Array:
    """Return times in s that rise.

    A joint service whose drive is silent goes on saying when its last sample came: messages
    with the same stamp are spread over the time until the next one, at most at half the
    usual rate.

    Args:
        stamps_ns: of messages, in the order in which they came.
        zero_ns: time zero.
    """
    t = (np.array(stamps_ns, dtype=np.int64) - zero_ns) / NS_PER_S
    t = np.maximum.accumulate(t) if len(t) else t
    steps = np.diff(t)
    if not len(steps) or steps.all():
        return t
    usual = float(np.median(steps[steps > 0.0])) if steps.any() else 0.0
    starts = np.flatnonzero(np.concatenate(([True], steps > 0.0)))
    counts = np.diff(np.append(starts, len(t)))
    until = np.append(t[starts[1:]], t[-1] + usual * counts[-1])
    step = np.minimum((until - t[starts]) / counts, 2.0 * usual)
    within = np.arange(len(t)) - np.repeat(starts, counts)
    return np.asarray(t + within * np.repeat(step, counts), dtype=np.float64)


def packed(t: Array, values: Array, span: Span) -> dict[str, Any] | None:
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
    bins = ((t - span.begin) / width).astype(np.int64)
    starts = np.flatnonzero(np.concatenate(([True], np.diff(bins) > 0)))
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    first, second = _ordered(values, starts, low, high)
    lo, hi = float(low.min()), float(high.max())
    step = (hi - lo) / STEPS
    codes = np.full((int(bins[-1] - bins[0]) + 1, 2), SKIP, dtype=np.int16)
    places = bins[starts] - bins[0]
    for column, extremes in enumerate((first, second)):
        scaled = np.rint((extremes - lo) / step) if step > 0.0 else np.zeros(len(extremes))
        codes[places, column] = np.clip(scaled, 0, STEPS).astype(np.int64) + FIRST
    silent = np.flatnonzero(np.diff(t) > _gap(t))
    after = bins[silent] - bins[0] + 1
    after = after[after < bins[silent + 1] - bins[0]]
    codes[after] = BREAK
    return {
        "t0": round(span.begin + float(bins[0]) * width, 6),
        "h": width / 2,
        "lo": lo,
        "hi": hi,
        "step": step,
        "d": base64.b64encode(codes.astype("<i2").tobytes()).decode(),
    }


def _gap(t: Array) -> float:
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    return max(GAP_S, 5.0 * usual)


def _ordered(
    values: Array, starts: NDArray[np.int64], low: Array, high: Array
) -> tuple[Array, Array]:
    """Return the two extremes of each bin, that which came first before the other."""
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
