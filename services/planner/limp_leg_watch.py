"""When the planner asks modules to stiffen because another one may be limp. Pure.

Services of one host see a limp neighbour without a planner (`services.joint.neighbours`). The
planner also asks those of other hosts, and for a module that is started again and stays DISARMED.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import DriveStatus, JointState, Mode
from shared.clock import NS_PER_MS
from shared.robot.joints import N_MODULES
from shared.robot.limp_leg_support import SUPPORT_FOR, Support

DISARMED_NS: Final = 200 * NS_PER_MS
"""A module that is DISARMED for so long is not about to take its drive over."""


class LimpLegWatch(msgspec.Struct):
    """Since when each module is DISARMED over a drive that does not hold it."""

    since_ns: tuple[int, ...] = (0,) * N_MODULES
    """0: it is not."""

    def advance(self, now_ns: int, states: Sequence[JointState]) -> Support:
        """Return which modules are to stiffen.

        FAULT counts whatever the drive does: one that is silent may hold, or have no power.

        Args:
            now_ns: the planner's clock.
            states: the newest of each module, however old.
        """
        self.since_ns = tuple(
            (since_ns or now_ns) if _is_down(state) else 0
            for since_ns, state in zip(self.since_ns, states, strict=True)
        )
        support = Support.NONE
        for state, since_ns, wanted in zip(states, self.since_ns, SUPPORT_FOR, strict=True):
            lasts = since_ns > 0 and now_ns - since_ns >= DISARMED_NS
            if lasts or state.mode == Mode.FAULT:
                support = max(support, wanted)
        return support


def _is_down(state: JointState) -> bool:
    return state.mode == Mode.DISARMED and state.drive != DriveStatus.HOLDING
