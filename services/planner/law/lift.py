"""Moves the robot's height by itself, slowly, when its motors get too warm for the pose. Pure.

Height and pitch belong to the person. While the planner moves the robot (`services.planner.watch.
heat`) both are held on local gains, and the reference of the height goes on at a bounded rate:

    z_ref = p + hold (z - p),  z' = rate,  |rate| <= RATE,  |z - p| <= lead
    F_lift' = FORCE_RATE (z - p) / lead,   0 <= F_lift <= FORCE_MAX

The reference hardly leads the robot: a joint service accepts no more. The force makes up for a
hand that resists. It acts at the COM: at the harness, ahead of the
pitch axis, it would turn a torso that nobody holds.
"""

from __future__ import annotations

from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared.clamp import clamp

Array = NDArray[np.float64]

Z, PITCH = 2, 4
RATE: Final = 0.05
"""m/s; from the deepest squat to straight legs in 6 s."""
SLEW: Final = 0.05
"""m/s^2"""
LEAD_ANGLE: Final = 0.08
"""rad by which the reference of a joint leads it: half of what trips, and of what a joint service
accepts (`trips.tracking`, `envelope.q_ref_distance`)."""
LEAD_MAX: Final = 0.02
"""m"""
HOLD_S: Final = 0.5
"""Time in which the hold fades in, and out."""
FORCE_RATE: Final = 60.0
"""N/s where the reference leads by all that it may."""
FORCE_MAX: Final = 200.0
"""N, beyond the assist: a leading hand presses with 150 N at the most, and with a full assist it is
no overload of the harness (500 N)."""
FADE_RATE: Final = 30.0
"""N/s with which the force goes once the robot is given back."""


class LiftState(msgspec.Struct):
    """State of `Lift`."""

    hold: float = 0.0
    """How much height and pitch are held, 0 .. 1."""
    z: float = 0.0
    """Reference of the COM's height, m."""
    pitch: float = 0.0
    """Where the pitch is held, rad."""
    rate: float = 0.0
    """m/s"""
    force: float = 0.0
    """N, upwards at the COM."""


class Lift:
    """Reference of the height while the planner moves it."""

    def __init__(self) -> None:
        """Start with height and pitch the person's."""
        self.state = LiftState()

    @property
    def is_holding(self) -> bool:
        """True while height and pitch are not, or not wholly, the person's."""
        return self.state.hold > 0.0

    def advance(self, direction: float | None, p: Array, T_z: Array, dt: float) -> float:
        """Advance by one tick; return the force, N.

        Args:
            direction: 1 up, 0 stay, -1 down; None: height and pitch are the person's.
            p: measured pose (6,).
            T_z: joint rates per unit of the height (12,), rad/m.
            dt: time since the last tick, s.
        """
        s, height = self.state, float(p[Z])
        if direction is None:
            s.hold = max(0.0, s.hold - dt / HOLD_S)
            s.force -= clamp(s.force, -FADE_RATE * dt, FADE_RATE * dt)
            s.rate -= clamp(s.rate, -SLEW * dt, SLEW * dt)
        else:
            if s.hold == 0.0:
                s.z, s.pitch, s.rate = height, float(p[PITCH]), 0.0
            s.hold = min(1.0, s.hold + dt / HOLD_S)
            s.rate += clamp(direction * RATE - s.rate, -SLEW * dt, SLEW * dt)
            lead = min(LEAD_MAX, LEAD_ANGLE / max(float(np.abs(T_z).max()), 1.0))
            s.z = clamp(s.z + s.hold * s.rate * dt, height - lead, height + lead)
            s.force += s.hold * FORCE_RATE * dt * (s.z - height) / lead
            s.force = clamp(s.force, 0.0, FORCE_MAX)
        return s.force

    def apply(self, p_ref: Array, pdot_ref: Array, p: Array, pdot: Array) -> None:
        """Hold height and pitch of a reference p_ref (6,) and its rates pdot_ref (6,)."""
        s = self.state
        if s.hold == 0.0:
            return
        for row, held, rate in ((Z, s.z, s.rate), (PITCH, s.pitch, 0.0)):
            p_ref[row] = p[row] + s.hold * (held - p[row])
            pdot_ref[row] = (1.0 - s.hold) * pdot[row] + s.hold * rate

    def reset(self) -> None:
        """Give the height back at once: the planner does not lead."""
        self.state.hold = self.state.rate = self.state.force = 0.0
