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

from services.planner.memory import ShiftMemory
from shared.messages import Vector4

Array = NDArray[np.float64]

ROWS: Final = np.array([0, 1, 3, 5])
"""Rows of p that are shifted: x, y, roll, yaw."""
SHIFT_S: Final = 1.0
"""The whole range from the middle takes so long, s."""
OMEGA: Final = 6.0
"""rad/s; critically damped."""


class ShiftReference:
    """The reference (x, y, roll, yaw) that follows what is asked."""

    def __init__(self, largest: Sequence[float]) -> None:
        """Take the largest shift each way: m, m, rad, rad."""
        self._largest = np.array(largest)
        self._fastest = self._largest / SHIFT_S
        self._at: Array = np.zeros(4)
        self._rate: Array = np.zeros(4)

    def advance(self, wanted: Vector4, dt: float) -> tuple[Array, Array]:
        """Follow for dt seconds; return the shift of p and its rate (6,), m and rad, per s.

        Args:
            wanted: x, y in m, roll, yaw in rad; beyond the limits: the limits.
            dt: since the last tick, s.
        """
        aim = np.clip(wanted, -self._largest, self._largest)
        pull = OMEGA * OMEGA * (aim - self._at) - 2.0 * OMEGA * self._rate
        self._rate = np.clip(self._rate + dt * pull, -self._fastest, self._fastest)
        self._at = self._at + dt * self._rate
        return self.now()

    def rest(self) -> tuple[Array, Array]:
        """Stay where it is, while nobody is led; return the same."""
        self._rate[:] = 0.0
        return self.now()

    def now(self) -> tuple[Array, Array]:
        """Return the shift of p and its rate (6,)."""
        shift, rate = np.zeros(6), np.zeros(6)
        shift[ROWS], rate[ROWS] = self._at, self._rate
        return shift, rate

    def remember(self) -> ShiftMemory:
        """Return the memory as it is now."""
        return ShiftMemory(_four(self._at), _four(self._rate))

    def recall(self, memory: ShiftMemory) -> None:
        """Go on from a memory."""
        self._at, self._rate = np.array(memory.at), np.array(memory.rate)


def _four(values: Array) -> Vector4:
    a, b, c, d = values.tolist()
    return a, b, c, d
