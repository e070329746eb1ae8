"""Second-order follower, with limits, for the operator's shift of the closed directions. Pure.

By itself the robot keeps its COM over the ankles and its torso upright. The operator may request a
small offset (`operator/intent`): COM forwards or sideways, torso rolled or yawed. The reference
follows without a jump. It takes at least `SHIFT_S` for the whole range and stays within
`law.shift_max`:

    r'' = w^2 (wanted - r) - 2 w r',   |r'| <= shift_max / SHIFT_S
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from shared.arrays import Array
from shared.bus.messages import Vector4
from shared.clamp import clamp

ROWS: Final = (0, 1, 3, 5)
"""Rows of p that the shift moves: x, y, roll, yaw."""
SHIFT_S: Final = 1.0
"""Shortest time from the middle to the end of the range, s."""
OMEGA: Final = 6.0
"""w, rad/s; the follower is critically damped."""


class ShiftState(msgspec.Struct):
    """State of `ShiftReference`: x, y in m, roll, yaw in rad, and their rates."""

    at: list[float] = msgspec.field(default_factory=lambda: [0.0] * len(ROWS))
    rate: list[float] = msgspec.field(default_factory=lambda: [0.0] * len(ROWS))

    def rest(self) -> None:
        """Stop at the current shift while the planner is not engaged."""
        self.rate = [0.0] * len(ROWS)

    def add_to(self, p: Array, pdot: Array) -> None:
        """Add the shift to a pose p (6,), m and rad, and its rate to pdot (6,), per s."""
        for row, at, rate in zip(ROWS, self.at, self.rate, strict=True):
            p[row] += at
            pdot[row] += rate


class ShiftReference:
    """Reference (x, y, roll, yaw) that follows the requested shift.

    It uses plain floats: for four values, NumPy's calls cost more than the arithmetic.
    """

    def __init__(self, shift_max: Sequence[float]) -> None:
        """Set the largest shift each way: m, m, rad, rad."""
        self._shift_max = tuple(shift_max)

    def advance(self, s: ShiftState, wanted: Vector4, dt: float) -> None:
        """Follow for dt seconds.

        Args:
            s: the shift, which changes.
            wanted: x, y in m, roll, yaw in rad; clipped to the limits.
            dt: time since the last tick, s.
        """
        at, rate = s.at, s.rate
        for i, limit in enumerate(self._shift_max):
            target, rate_max = clamp(wanted[i], -limit, limit), limit / SHIFT_S
            rate_next = rate[i] + dt * OMEGA * (OMEGA * (target - at[i]) - 2.0 * rate[i])
            rate[i] = clamp(rate_next, -rate_max, rate_max)
            at[i] += dt * rate[i]
