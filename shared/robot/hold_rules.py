"""Rules shared by planner and joint services: who stiffens, and who waits longer. Pure."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import msgspec

from shared.joints import MODULES, kind_of


class Support(IntEnum):
    """Modules that stiffen when another one is limp.

    HOLD leaves the hips' theta as soft as the planner had it, because the hand may keep leading
    (`RobotConfig.hold_gains`). With soft hips and knees a leg with a limp knee folds: it fell at
    every phase of the squat. On stand gains the thigh is fixed to the torso and the leg is a strut:
    none fell (`tests/lockstep/test_faults.py`), nor through pushes of 30 N. In the crawl, under the
    hand's 60 N m of pitch, little is left for a push forwards: 20 N stood, 30 N fell. The hips then
    have gains of their own (`joint_service.limp_leg_hip_theta`): on their stand gains the torso
    turned by up to 0.9 rad once the hand let go, and straight legs fell.

    A limp ankle leaves one sole to stand on. Stiff hips would pass the hand's 60 N m of pitch to
    it; stiff knees alone keep the legs from giving. Fell, of 12 each with and without pushes of
    30 N:

        stiff               none  knees  all
        squat, ankle limp      4      2    0
        crawl, ankle limp     12      6   12

    A limp hip needs nothing: the other hip carries the torso.
    """

    NONE = 0
    KNEES = 1
    ALL = 2

    def includes(self, module: str) -> bool:
        """Return True if this module stiffens."""
        if not self:  # the usual case
            return False
        return self is Support.ALL or kind_of(module) == "knee"


_BY_KIND: Final = {"ankle": Support.KNEES, "knee": Support.ALL, "hip": Support.NONE}
SUPPORT_FOR: Final = tuple(_BY_KIND[kind_of(name)] for name in MODULES)
"""Modules that stiffen if this one is limp, in the order of `MODULES`."""


class Dropouts(msgspec.Struct):
    """Recent drop-outs; each steady time without a drop-out forgets one.

    More drop-outs mean a longer wait before engaging again. A joint service counts drop-outs of its
    commands, the planner those of its modules (docs/architecture.md#modes). Otherwise links that
    fail in turn would make the robot flap between TRACK and HOLD.
    """

    count: int = 0
    last_ns: int = 0
    """Time of the last drop-out."""
    steady_since_ns: int = 0
    """Start of the present time engaged without a drop-out; restarts when one is forgotten."""

    def advance(
        self, now_ns: int, *, engaged: bool, dropped: bool, count_max: int, forget_ns: int
    ) -> None:
        """Advance by one cycle.

        `engaged`: the module tracked, or the planner led, before this cycle; `dropped`: that ended
        in it. Drop-outs beyond `count_max` are not counted: they would only take longer to forget.
        """
        if not engaged:
            self.steady_since_ns = now_ns
        elif dropped:
            self.count = min(self.count + 1, count_max)
            self.last_ns = self.steady_since_ns = now_ns
        elif self.count and now_ns - self.steady_since_ns >= forget_ns:
            self.count -= 1
            self.steady_since_ns = now_ns
