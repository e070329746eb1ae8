"""Two rules that planner and joint services share: who stiffens, and who waits longer. Pure."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import msgspec

from shared.joints import MODULES, kind_of


class Support(IntEnum):
    """Which modules stiffen when another one is limp.

    HOLD leaves the theta of hips as soft as the planner had them, because the hand leads on
    (`RobotConfig.hold_gains`); before it stiffened the knees it left theirs, too. On those gains a
    leg with a limp knee folds: it fell at every phase of the squat. With every gain at its stand
    gain the thigh is fixed to the torso and the leg stands as a strut: none fell
    (`tests/lockstep/test_faults.py`), nor through pushes of 30 N. In the crawl, under the hand's 60
    N m of pitch, it stands, with little left for a push forwards: 20 N stood, 30 N fell. The hips
    then have gains of their own (`joint_service.limp_leg_hip_theta`): on their stand gains the
    torso turned by up to 0.9 rad once the hand let go, and straight legs fell.

    A limp ankle leaves one sole to stand on. Stiff hips would hand it the hand's 60 N m of pitch;
    stiff knees alone keep the legs from giving. Fell, of 12 each with and without pushes of 30 N:

        stiff               none  knees  all
        squat, ankle limp      4      2    0
        crawl, ankle limp     12      6   12

    A limp hip needs nothing: the other one carries the torso.
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
"""Which modules stiffen if this one is limp, in the order of `MODULES`."""


class Dropouts(msgspec.Struct):
    """Recent drop-outs; each steady time without one forgets one.

    Whoever engages again waits the longer the more there were: a joint service counts those of its
    commands, the planner those of its modules (docs/architecture.md#modes). Links that fail in turn
    would otherwise make the robot flap between TRACK and HOLD.
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

        Before it the module tracked or the planner led, if `engaged`; in it that dropped out, if
        `dropped`. More than `count_max` are not counted: they would only take longer to forget.
        """
        if not engaged:
            self.steady_since_ns = now_ns
        elif dropped:
            self.count = min(self.count + 1, count_max)
            self.last_ns = self.steady_since_ns = now_ns
        elif self.count and now_ns - self.steady_since_ns >= forget_ns:
            self.count -= 1
            self.steady_since_ns = now_ns
