"""Where the person asks the closed directions to be: a follower with limits. Pure.

The robot keeps its COM over the ankles and its torso straight by itself. A person may ask for a
little off that (`operator/intent`): COM forwards or aside, torso rolled or turned. The reference
goes there without a jump, no faster than `SHIFT_S` for the whole range, and no farther than
`law.shift_max`:

    r'' = w^2 (wanted - r) - 2 w r',   |r'| <= shift_max / SHIFT_S
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.planner.snapshots import ShiftState
from shared.messages import Vector4

Array = NDArray[np.float64]

ROWS: Final = (0, 1, 3, 5)
"""Rows of p that are shifted: x, y, roll, yaw."""
SHIFT_S: Final = 1.0
"""The whole range from the middle takes so long, s."""
OMEGA: Final = 6.0
"""rad/s; critically damped."""


class ShiftReference:
    """The reference (x, y, roll, yaw) that follows what is asked.

    In plain numbers: NumPy's calls on four of them cost more than the arithmetic.
    """

    def __init__(self, largest: Sequence[float]) -> None:
        """Take the largest shift each way: m, m, rad, rad."""
        self._largest = tuple(largest)
        self._at = [0.0] * len(ROWS)
        self._rate = [0.0] * len(ROWS)

    def advance(self, wanted: Vector4, dt: float) -> None:
        """Follow for dt seconds.

        Args:
            wanted: x, y in m, roll, yaw in rad; beyond the limits: the limits.
            dt: since the last tick, s.
        """
        at, rate = self._at, self._rate
        for i, most in enumerate(self._largest):
            aim, fastest = min(most, max(-most, wanted[i])), most / SHIFT_S
            speed = rate[i] + dt * OMEGA * (OMEGA * (aim - at[i]) - 2.0 * rate[i])
            rate[i] = min(fastest, max(-fastest, speed))
            at[i] += dt * rate[i]

    def rest(self) -> None:
        """Stay where it is while nobody is led."""
        self._rate = [0.0] * len(ROWS)

    def add_to(self, p: Array, pdot: Array) -> None:
        """Add the shift to a pose p (6,), m and rad, and its rate to pdot (6,), per s."""
        for row, at, rate in zip(ROWS, self._at, self._rate, strict=True):
            p[row] += at
            pdot[row] += rate

    def snapshot(self) -> ShiftState:
        """Return the state."""
        return ShiftState(_four(self._at), _four(self._rate))

    def restore(self, memory: ShiftState) -> None:
        """Continue from a state."""
        self._at, self._rate = list(memory.at), list(memory.rate)


def _four(values: Sequence[float]) -> Vector4:
    a, b, c, d = values
    return a, b, c, d
