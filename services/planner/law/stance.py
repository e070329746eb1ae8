"""Adopts the stance of the feet from the joints, relative to the robot file. Pure.

The law knows its feet by the joints alone. Both legs carry the same torso, so two estimates of one
torso show a foot that is ahead, turned, or nearer than `geometry.w_base`. Before the planner
engages, it adopts the stance in which the legs agree. It keeps that stance while engaged. No leg
then works against the other, and each foot gets a wrench that its own position allows. With the
feet taken from the file, 0.1 m too wide tipped a sole by 0.18 rad; with the measured stance, by
0.002 rad.

While the planner is not engaged, the stance follows the joints slowly. Feet that were moved in HOLD
are found, and a sole that lifts in a sway is not mistaken for one. A planner that has not been
engaged yet cannot tell the two apart. If it starts while a push tips the soles, it keeps that
stance until it disengages again.

Zero errors of the joints become part of the stance: they look like feet that are slightly off. The
planner refuses a stance beyond `law.stance_max`: it was not shown to stand, or something is broken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from shared.arrays import Array, vector6
from shared.bus.messages import AS_CONFIGURED, Vector6

_ROWS: Final = (
    ("ahead of", "behind", "mm"),
    ("too near", "too far from", "mm"),
    ("higher than", "lower than", "mm"),
    ("inner edge up against", "outer edge up against", "deg"),
    ("pitched toes down against", "pitched toes up against", "deg"),
    ("turned inwards against", "turned outwards against", "deg"),
)
"""Right foot relative to the left: text for a positive and a negative row of a stance, and its
unit."""
_TO_UNIT: Final = {"mm": 1e3, "deg": 180.0 / math.pi}

FOLLOW_S: Final = 2.0
"""s; time constant with which a planner that was engaged before follows a new stance."""
FOLLOW_TOLERANCE: Final = 0.03
"""m or rad; the planner does not engage while adopted and measured stance differ by more."""


class StanceState(msgspec.Struct):
    """State of `Stance`."""

    taken: Vector6 = AS_CONFIGURED
    """Adopted stance of the right foot relative to the left, as deviation from the robot file:
    x, y, z in m and a rotation vector in rad, world axes."""
    refusal: str = ""
    """Why the stance measured last is refused: it is beyond the limits, or the feet have moved and
    their new stance is not adopted yet. "" if it is accepted."""


class Stance:
    """Follows the stance of the feet within limits."""

    def __init__(self, stance_max: Sequence[float]) -> None:
        """Set the limits.

        Args:
            stance_max: `law.stance_max`, m and rad; a zero row is neither adopted nor refused.
        """
        self._stance_max: Array = np.array(stance_max)

    def advance(self, s: StanceState, measured: Array, fraction: float = 1.0) -> None:
        """Adopt the stance in which the legs agree now.

        Args:
            s: the stance, which changes.
            measured: (6,), m and rad.
            fraction: of the way to it; 1 adopts it at once.
        """
        if not np.isfinite(measured).all():  # nothing to follow
            s.refusal = "the joint angles give no stance: check the encoders"
            return
        checked, taken = self._stance_max > 0.0, np.array(s.taken)
        beyond = bool((checked & (np.abs(measured) > self._stance_max)).any())
        wanted = np.where(checked, measured, 0.0)
        if not beyond:  # a refused stance is not followed: it may be a broken encoder
            taken += fraction * (wanted - taken)
            s.taken = vector6(taken)
        moved = bool((np.abs(wanted - taken) > FOLLOW_TOLERANCE).any())
        s.refusal = self._refusal(measured) if beyond or moved else ""

    def _refusal(self, measured: Array) -> str:
        rows = zip(measured.tolist(), self._stance_max.tolist(), _ROWS, strict=True)
        return (
            "; ".join(
                f"the right foot is {abs(value) * _TO_UNIT[unit]:.0f} {unit} "
                f"{positive if value > 0.0 else negative} the left: "
                f"at most {limit * _TO_UNIT[unit]:.0f} {unit} is accepted (law.stance_max)"
                for value, limit, (positive, negative, unit) in rows
                if 0.0 < limit < abs(value)
            )
            or "the feet have moved: wait until the planner has adopted the new stance"
        )
