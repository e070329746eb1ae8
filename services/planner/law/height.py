"""Reference of a height that the robot goes to by itself, down or up, without a hand. Pure.

Height and torso pitch are open: a hand leads them. To go down (`xrl down`, a low battery) or up
(`services.planner.watch.heat`) the law closes both. The height's reference h moves at a bounded
rate until a knee is at the end of its range; the pitch's stays where it was. It begins at the
measured pose and rate, so nothing steps. z is the measured height.

    p_ref    = (1 - hold) p_ref    + hold (h, pitch)
    pdot_ref = (1 - hold) pdot_ref + hold (h', 0)
    |h'| <= RATE_MAX,  |h''| <= ACCELERATION,  |h' | <= APPROACH (distance of the knee from its end)
    |h - z| <= lead: a joint service accepts no more, and a hand that holds the robot stops it
    F_lift'  = FORCE_RATE (h - z) / lead,   0 <= F_lift <= FORCE_MAX, upwards only

The force makes up for a hand that presses on a robot that is to rise. It acts at the COM: at the
harness, ahead of the pitch axis, it would turn a torso that nobody holds.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import msgspec
import numpy as np

from shared.arrays import Array
from shared.bus.messages import Pair
from shared.clamp import clamp


class Toward(IntEnum):
    """Where the robot goes by itself."""

    DOWN = -1
    REST = 0
    """It stays where it is."""
    UP = 1
    PERSON = 2
    """Nowhere: height and pitch are the person's."""


RATE_MAX: Final = 0.05
"""m/s; from the deepest squat to straight legs in 6 s."""
ACCELERATION: Final = 0.1
"""m/s^2"""
APPROACH: Final = 0.2
"""m/s per rad of the knee: the last centimetres take seconds."""
HOLD_S: Final = 0.5
"""Time in which the hold of height and pitch fades in, and out, s."""
LEAD_MAX: Final = 0.012
"""m; over the local springs that is 65 N of a hand, beyond the load that is estimated."""
LEAD_ANGLE: Final = 0.08
"""rad by which the reference of a joint leads it: half of what trips, and of what a joint service
accepts (`trips.tracking`, `envelope.q_ref_distance`)."""
LEAD_PITCH: Final = 0.12
"""rad"""
FORCE_RATE: Final = 60.0
"""N/s where the reference leads by all that it may."""
FORCE_MAX: Final = 200.0
"""N, beyond the assist: a leading hand presses with 150 N at the most, and with a full assist it is
no overload of the harness (500 N)."""
FADE_RATE: Final = 30.0
"""N/s with which the force goes once the robot no longer rises."""
_ROWS: Final = (2, 4)

# Compared in each tick: docs/contributing.md, The control path.
_DOWN, _UP, _PERSON = Toward.DOWN, Toward.UP, Toward.PERSON


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
    force: float = 0.0
    """F_lift, N, upwards at the COM."""


class HeightReference:
    """Closes height and pitch while the robot goes up or down by itself."""

    def __init__(self, knees: Pair) -> None:
        """Take the ends of the knees' way, theta in rad: the lowest pose, the highest."""
        self._knees = knees
        self.state = HeightState()

    @property
    def is_active(self) -> bool:
        """True while height and pitch are not wholly the person's, or some force is left."""
        return self.state.hold > 0.0 or self.state.force > 0.0

    def advance(
        self, toward: Toward, p: Array, pdot: Array, T_z: Array, knees: Pair, dt: float
    ) -> float:
        """Advance by one tick; return the force, N.

        Args:
            toward: where to.
            p: measured pose (6,), m and rad.
            pdot: its rate (6,).
            T_z: joint rates per unit of the height (12,), rad/m.
            knees: theta of both, rad.
            dt: time since the last tick, s.
        """
        s, z, pitch = self.state, float(p[2]), float(p[4])
        wanted = 0.0
        if toward is _PERSON:
            s.hold = max(0.0, s.hold - dt / HOLD_S)
        else:
            if s.hold == 0.0:
                s.height, s.rate, s.pitch = z, float(pdot[2]), pitch
            s.hold = min(1.0, s.hold + dt / HOLD_S)
            low, high = self._knees
            left = min(knees) - low if toward is _DOWN else high - max(knees)
            wanted = toward * min(RATE_MAX, APPROACH * max(0.0, left))
        lead = min(LEAD_MAX, LEAD_ANGLE / max(float(np.abs(T_z).max()), 1.0))
        if s.hold > 0.0:
            step = ACCELERATION * dt
            s.rate += clamp(wanted - s.rate, -step, step)
            s.height = clamp(s.height + dt * s.rate, z - lead, z + lead)
            s.pitch = clamp(s.pitch, pitch - LEAD_PITCH, pitch + LEAD_PITCH)
        if toward is _DOWN or toward is _PERSON:
            s.force -= clamp(s.force, 0.0, FADE_RATE * dt)
        else:
            s.force += s.hold * FORCE_RATE * dt * (s.height - z) / lead
            s.force = clamp(s.force, 0.0, FORCE_MAX)
        return s.force

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
        self.state.hold = self.state.rate = self.state.force = 0.0
