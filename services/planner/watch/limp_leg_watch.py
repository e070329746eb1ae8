"""Requests stiffening from modules when another one may be limp. Pure.

Joint services on one host detect a limp neighbour without a planner (`services.joint.neighbours`).
The planner adds modules on other hosts, and a module that restarts and stays DISARMED.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import DriveStatus, JointState, Mode
from shared.clock import NS_PER_MS
from shared.joints import N_MODULES
from shared.robot.hold_rules import SUPPORT_FOR, Support

DISARMED_NS: Final = 200 * NS_PER_MS
"""ns; a module DISARMED for this long is not about to take its drive over."""

# Compared in each tick, for six modules: docs/contributing.md, The control path.
_DISARMED, _FAULT, _HOLDING = Mode.DISARMED, Mode.FAULT, DriveStatus.HOLDING


class LimpLegWatch(msgspec.Struct):
    """Times since which each module is DISARMED while its drive does not hold."""

    since_ns: tuple[int, ...] = (0,) * N_MODULES
    """0 if it is not."""

    def advance(self, now_ns: int, states: Sequence[JointState]) -> Support:
        """Return which modules are to stiffen.

        FAULT counts in any state of the drive: a drive that does not reply may hold, or have no
        power.

        Args:
            now_ns: the planner's clock.
            states: the newest of each module, of any age.
        """
        self.since_ns = tuple(
            (since_ns or now_ns) if _is_down(state) else 0
            for since_ns, state in zip(self.since_ns, states, strict=True)
        )
        support = Support.NONE
        for state, since_ns, wanted in zip(states, self.since_ns, SUPPORT_FOR, strict=True):
            persists = since_ns > 0 and now_ns - since_ns >= DISARMED_NS
            if persists or state.mode == _FAULT:
                support = max(support, wanted)
        return support


def _is_down(state: JointState) -> bool:
    return state.mode == _DISARMED and state.drive != _HOLDING
