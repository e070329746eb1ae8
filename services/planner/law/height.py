"""Reference of a height that the robot goes to by itself, down or up, without a hand. Pure.

Height and torso pitch are open: a hand leads them. Asked to go, the law closes both. The height's
reference h moves at a bounded rate until a knee is at the end of its range; the pitch's stays where
it was. It begins at the measured pose and rate, so nothing steps.

    p_ref    = (1 - hold) p_ref    + hold (h, pitch)
    pdot_ref = (1 - hold) pdot_ref + hold (h', 0)
    |h'| <= RATE_MAX,  |h''| <= ACCELERATION,  |h' | <= APPROACH (distance of the knee from its end)
    |h - z| <= LEASH: a hand that holds the robot up pulls the reference along, and so stops it
"""

from __future__ import annotations

from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared.bus.messages import Pair
from shared.clamp import clamp

Array = NDArray[np.float64]

DOWN: Final = -1
STAY: Final = 0
UP: Final = 1
RATE_MAX: Final = 0.05
"""m/s"""
ACCELERATION: Final = 0.1
"""m/s^2"""
APPROACH: Final = 0.2
"""m/s per rad of the knee: the last centimetres take seconds."""
HOLD_S: Final = 0.5
"""Time in which the hold of height and pitch fades in, and out, s."""
LEASH: Final = (0.012, 0.12)
"""m and rad; over the local springs that is 65 N of a hand, beyond the load that is estimated."""
_ROWS: Final = (2, 4)


class HeightState(msgspec.Struct, array_like=True):
    """State of `HeightReference`."""

    height: float = 0.0
    """h, m."""
    rate: float = 0.0
    """h', m/s."""
    pitch: float = 0.0
    """rad"""
    hold: float = 0.0
    """How much of both is used, 0 .. 1; 0: the person leads."""


class HeightReference:
    """Closes height and pitch while the robot is to go up or down by itself."""

    def __init__(self, knees: Pair) -> None:
        """Take the ends of the knees' way, theta in rad: the lowest pose, the highest."""
        self._knees = knees
        self.state = HeightState()

    def advance(self, toward: int, p: Array, pdot: Array, knees: Pair, dt: float) -> None:
        """Advance by one tick.

        Args:
            toward: `DOWN`, `UP`, or `STAY`: give height and pitch back to the person.
            p: measured pose (6,), m and rad.
            pdot: its rate (6,).
            knees: theta of both, rad.
            dt: time since the last tick, s.
        """
        s, z, pitch = self.state, float(p[2]), float(p[4])
        if toward == STAY:
            s.hold = max(0.0, s.hold - dt / HOLD_S)
            wanted = 0.0
        else:
            if s.hold == 0.0:
                s.height, s.rate, s.pitch = z, float(pdot[2]), pitch
            s.hold = min(1.0, s.hold + dt / HOLD_S)
            low, high = self._knees
            left = max(0.0, min(knees) - low) if toward == DOWN else max(0.0, high - max(knees))
            wanted = toward * min(RATE_MAX, APPROACH * left)
        if s.hold == 0.0:
            return
        step = ACCELERATION * dt
        s.rate += clamp(wanted - s.rate, -step, step)
        s.height = clamp(s.height + dt * s.rate, z - LEASH[0], z + LEASH[0])
        s.pitch = clamp(s.pitch, pitch - LEASH[1], pitch + LEASH[1])

    def apply(self, p_ref: Array, pdot_ref: Array) -> None:
        """Close height and pitch in a reference p_ref (6,) and its rate pdot_ref (6,)."""
        s = self.state
        if s.hold == 0.0:
            return
        for row, at, rate in zip(_ROWS, (s.height, s.pitch), (s.rate, 0.0), strict=True):
            p_ref[row] += s.hold * (at - p_ref[row])
            pdot_ref[row] += s.hold * (rate - pdot_ref[row])

    def reset(self) -> None:
        """End at once: the planner does not lead."""
        self.state.hold = 0.0
