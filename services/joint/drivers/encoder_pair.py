"""Samples of a module out of the estimates of its two axes, which come one by one. Pure."""

from __future__ import annotations

from math import isfinite
from typing import Final

from shared.bus.messages import Pair

PAIR_SHARE: Final = 0.6
"""Fraction of the period; an older estimate belongs to the previous sample, as after a lost frame.
More than half, so that axes out of step still make pairs."""

_BOTH: Final = 0b11


class EncoderPair:
    """The newest estimates of both axes, and whether they make a sample that was not taken yet.

    Attributes:
        estimates: position and velocity of axis0, then of axis1, turns and turn/s.
    """

    def __init__(self) -> None:
        self.estimates: list[Pair] = [(0.0, 0.0), (0.0, 0.0)]
        self._came_ns = [0, 0]
        self._fresh = 0  # bit i: axis i has an estimate since the last sample

    def take(self, axis: int, estimate: Pair, now_ns: int) -> None:
        """Take an estimate of axis 0 or 1; one that is not a finite number is ignored."""
        pos, vel = estimate
        if not (isfinite(pos) and isfinite(vel)):
            return
        self.estimates[axis] = estimate
        came = self._came_ns
        if now_ns - came[1 - axis] > PAIR_SHARE * (now_ns - came[axis]):
            # Without this one lost frame would put one axis a period behind the other for good.
            self._fresh = 0
        came[axis] = now_ns
        self._fresh |= 1 << axis

    def forget(self) -> None:
        """Start over: earlier estimates belong to no sample."""
        self._fresh = 0

    def complete(self) -> bool:
        """Return True, once for each sample, if both axes have an estimate of the same period."""
        if self._fresh != _BOTH:
            return False
        self._fresh = 0
        return True
