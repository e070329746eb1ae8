"""Rules that planner and joint services share: stiffening, and waits after dropouts. Pure."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import msgspec

from shared.joints import MODULES, kind_of


class Support(IntEnum):
    """Modules that stiffen when another one is limp.

    HOLD leaves the hips' theta as soft as the planner set it, because the hand may keep leading
    (`RobotConfig.hold_gains`). With soft hips and knees a leg with a limp knee folds: the robot
    fell in every phase of the squat. With stiff hips and knees the thigh is fixed to the torso and
    the leg is a strut: in the squat no robot fell (`tests/lockstep/test_faults.py`), even when
    pushed with 30 N. In the crawl, under the hand's pitch moment of 60 N m, the robot withstood a
    forward push of 20 N but not of 30 N. The stiff modules use their stand gains, except for the
    hips' theta (`joint_service.limp_leg_hip_theta`): with stand gains there, the torso turned by up
    to 0.9 rad once the hand let go, and robots on straight legs fell.

    With a limp ankle the robot stands on one sole. Stiff hips would pass the hand's 60 N m to this
    sole; stiff knees alone keep the legs from folding. Falls in 12 cases each, with and without
    pushes of 30 N:

        stiff               none  knees  all
        squat, ankle limp      4      2    0
        crawl, ankle limp     12      6   12

    If a hip is limp, no module stiffens: the other hip carries the torso.
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
    """Count of recent dropouts, which falls by one after each steady period.

    It lengthens the wait before engaging again. A joint service counts dropouts of its commands,
    the planner those of its modules (docs/architecture.md#modes). Without this wait, links that
    fail in turn would make the robot alternate between TRACK and HOLD.
    """

    count: int = 0
    last_ns: int = 0
    """Time of the last dropout."""
    steady_since_ns: int = 0
    """Start of the present steady period: engaged, without a dropout."""

    def advance(
        self, now_ns: int, *, engaged: bool, dropped: bool, count_max: int, forget_ns: int
    ) -> None:
        """Advance by one cycle.

        `engaged`: the module tracked, or the planner led, before this cycle; `dropped`: it
        stopped doing so in this cycle. Dropouts beyond `count_max` are not counted, because they
        would only take longer to forget.
        """
        if not engaged:
            self.steady_since_ns = now_ns
        elif dropped:
            self.count = min(self.count + 1, count_max)
            self.last_ns = self.steady_since_ns = now_ns
        elif self.count and now_ns - self.steady_since_ns >= forget_ns:
            self.count -= 1
            self.steady_since_ns = now_ns
