"""Which modules are to hold with all they have, because another one may be limp. Pure.

HOLD leaves the theta of hips and knees as soft as the planner had them, for the hand leads on
(`RobotConfig.hold_gains`). On these a leg whose knee is limp folds: it fell at every phase of the
squat. With every gain at its stand gain the thigh is fixed to the torso and the leg stands as a
strut: none fell (`tests/lockstep/test_limp.py`), nor through pushes of 30 N. In the crawl, under
the hand's 60 N m of pitch, it stands, with little left for a push forwards: 20 N stood, 30 N fell.

A limp ankle leaves one sole to stand on. Stiff hips would hand it the hand's 60 N m of pitch; stiff
knees alone keep the legs from giving. Fell, of 12 each with and without pushes of 30 N:

    braced              none  knees  all
    squat, ankle limp      4      2    0
    crawl, ankle limp     12      6   12

A limp hip needs nothing: the other one carries the torso.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Final

import msgspec

from shared.clock import NS_PER_MS
from shared.joints import MODULES, N_MODULES, kind_of
from shared.messages import DriveStatus, JointState, Mode

DISARMED_NS: Final = 200 * NS_PER_MS
"""A module that is DISARMED for so long is not about to take its drive over."""


class Brace(IntEnum):
    """Who is to brace."""

    NONE = 0
    KNEES = 1
    ALL = 2

    def of(self, module: str) -> bool:
        """Return True if this module is to brace."""
        return self is Brace.ALL or (self is Brace.KNEES and kind_of(module) == "knee")


_FOR: Final = {"ankle": Brace.KNEES, "knee": Brace.ALL, "hip": Brace.NONE}
FOR_MODULE: Final = tuple(_FOR[kind_of(name)] for name in MODULES)
"""Who is to brace if this module is limp."""


class Bracing(msgspec.Struct):
    """Since when each module is DISARMED over a drive that does not hold it."""

    since_ns: tuple[int, ...] = (0,) * N_MODULES
    """0: it is not."""

    def advance(self, now_ns: int, states: Sequence[JointState]) -> Brace:
        """Return who is to brace.

        FAULT counts whatever the drive does: one that is silent may hold, or have no power.

        Args:
            now_ns: the planner's clock.
            states: the newest of each module, however old.
        """
        self.since_ns = tuple(
            (since_ns or now_ns) if _is_down(state) else 0
            for since_ns, state in zip(self.since_ns, states, strict=True)
        )
        brace = Brace.NONE
        for state, since_ns, wanted in zip(states, self.since_ns, FOR_MODULE, strict=True):
            lasts = since_ns > 0 and now_ns - since_ns >= DISARMED_NS
            if lasts or state.mode == Mode.FAULT:
                brace = max(brace, wanted)
        return brace


def _is_down(state: JointState) -> bool:
    return state.mode == Mode.DISARMED and state.drive != DriveStatus.HOLDING
