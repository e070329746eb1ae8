"""Limits a number to a range. Pure."""

from __future__ import annotations


def clamp(value: float, low: float, high: float) -> float:
    """Return a value limited to low .. high; a NaN becomes `low`.

    In Python 3.11 it costs a quarter of `min(high, max(low, value))`, which is equal to the last
    bit; a joint cycle limits a dozen numbers.
    """
    return high if value > high else value if value > low else low
