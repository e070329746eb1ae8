"""Where the feet stand, against where the robot file has them. Pure.

The law knows its feet by the joints alone: both legs carry the same torso, so a foot that is
ahead, turned, or nearer than `geometry.w_base` shows as two places for one torso. Before the
planner leads it takes the stance in which the legs agree, and keeps it while it leads: then no leg
works against the other, and each foot is asked for what its own place lets it give. With the feet
taken as in the file, 0.1 m too wide tipped a sole by 0.18 rad; taken as they stand, by 0.002.

Between two times of leading it follows the joints slowly: feet that were moved in HOLD are found,
and a sole that lifts in a sway is not taken for one. A planner that has not led yet cannot tell the
two apart: started while a push tips the soles, it keeps what it saw then until it is not led again.

Zero errors of the joints are taken along: they look like feet that are a little off. A stance
beyond `law.stance_max` is not led: it was not shown to stand, or something is broken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shared.bus.messages import Vector6

Array = NDArray[np.float64]

_ROWS: Final = (
    ("ahead of", "behind", "mm"),
    ("too near", "too far from", "mm"),
    ("higher than", "lower than", "mm"),
    ("inner edge up against", "outer edge up against", "deg"),
    ("pitched toes down against", "pitched toes up against", "deg"),
    ("turned inwards against", "turned outwards against", "deg"),
)
"""The right foot against the left, a positive and a negative row of a stance, and its unit."""
_TO_UNIT: Final = {"mm": 1e3, "deg": 180.0 / math.pi}

FOLLOW_S: Final = 2.0
"""A planner that has led takes a new stance in about this time, s."""
FOLLOW_MIN: Final = 0.03
"""m or rad: until the stance taken is so near to the one measured, it is not led."""


class Stance:
    """The stance that the law reckons with.

    Attributes:
        taken: (6,) the right foot against the left, beyond the robot file: x, y, z in m and a
            rotation vector in rad, world axes.
        refused: True while the feet stand farther off than the law leads them, or have moved and
            are not followed yet.
    """

    def __init__(self, largest: Sequence[float]) -> None:
        """Begin with the feet as configured.

        Args:
            largest: `law.stance_max`, m and rad; zero in a row: it is not taken, nor refused.
        """
        self._largest: Array = np.array(largest)
        self.taken: Array = np.zeros(6)
        self._measured: Array = np.zeros(6)
        self.refused = False

    def take(self, measured: Array, share: float = 1.0) -> None:
        """Take the stance in which the legs agree now.

        Args:
            measured: (6,), m and rad.
            share: of the way there; 1: at once.
        """
        self._measured[:] = measured
        if not np.isfinite(measured).all():  # by angles that are none: nothing to follow
            self.refused = True
            return
        heeded = self._largest > 0.0
        beyond = bool((heeded & (np.abs(measured) > self._largest)).any())
        wanted = np.where(heeded, measured, 0.0)
        if not beyond:  # what is refused is not followed: it may be a broken encoder
            self.taken += share * (wanted - self.taken)
        self.refused = beyond or bool((np.abs(wanted - self.taken) > FOLLOW_MIN).any())

    def refusal(self) -> str:
        """Return in words why the stance measured last is not led."""
        if not np.isfinite(self._measured).all():
            return "the joints' angles make no stance"
        rows = zip(self._measured.tolist(), self._largest.tolist(), _ROWS, strict=True)
        return (
            "; ".join(
                f"the right foot is {abs(value) * _TO_UNIT[unit]:.0f} {unit} "
                f"{more if value > 0.0 else less} the left: "
                f"at most {most * _TO_UNIT[unit]:.0f} {unit} is led (law.stance_max)"
                for value, most, (more, less, unit) in rows
                if 0.0 < most < abs(value)
            )
            or "the feet have moved: wait until their new places are taken"
        )

    def snapshot(self) -> tuple[Vector6, bool]:
        """Return the state."""
        a, b, c, d, e, f = self.taken.tolist()
        return (a, b, c, d, e, f), self.refused

    def restore(self, memory: tuple[Vector6, bool]) -> None:
        """Continue from a state."""
        self.taken[:], self.refused = memory
