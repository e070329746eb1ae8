"""A hand that is led from outside a scenario: it follows what is asked for, and never jumps."""

from __future__ import annotations

import math
from typing import Final

BANDWIDTH: Final = 8.0
"""rad/s; critically damped."""


class Follower:
    """One coordinate: a critically damped second-order system with a limit on its rate."""

    def __init__(self, at: float, rate_max: float) -> None:
        """Rest at a place; the rate is in its unit per second."""
        self.at, self.rate, self._rate_max = at, 0.0, rate_max

    def advance(self, wanted: float, dt: float) -> None:
        """Advance by dt, s. In closed form: stable whatever dt is.

        Args:
            wanted: where to go.
            dt: time since the last call, s.
        """
        # x'' = w^2 (wanted - x) - 2 w x', whose error is (a + b t) exp(-w t)
        error, w = self.at - wanted, BANDWIDTH
        slope = self.rate + w * error
        decay = math.exp(-w * dt)
        before = self.at
        self.at = wanted + (error + slope * dt) * decay
        self.rate = (slope - w * (error + slope * dt)) * decay
        if abs(self.rate) > self._rate_max or abs(self.at - before) > self._rate_max * dt:
            self.rate = math.copysign(self._rate_max, wanted - before)
            self.at = before + self.rate * dt
