"""Watches the voltage of the drives' supplies: a battery that runs low is told early. Pure.

    low      below `supply.low_v`: the person is told, with the number
    sits     below `supply.sit_v`: the robot goes down by itself (`services.planner.law.height`)

A supply without power makes its modules limp, and the robot falls: from its lowest pose as hard as
from a stand. Down, a stand can be put under the torso; that is what the time is for. The lowest
of the six counts, low-passed: a step of the load is no empty battery. Both last until the supply is
`RECOVERED_V` above their level, because a battery recovers as soon as its load is less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import JointState
from shared.config.sections import SupplyConfig
from shared.joints import MODULES

POLE_S: Final = 2.0
"""Time constant, s."""
RECOVERED_V: Final = 1.0


class SupplyState(msgspec.Struct):
    """State of `SupplyWatch`."""

    volts: float = 0.0
    """Lowest supply, low-passed, V; 0: none is known."""
    module: str = ""
    """Whose it is."""
    was_well: bool = False
    """It was above `supply.low_v`. One that never was is another battery than the file says, and
    moves nothing."""
    low: bool = False
    sits: bool = False


class SupplyWatch:
    """Compares the lowest supply with its levels."""

    def __init__(self, config: SupplyConfig) -> None:
        """Take the levels, V; 0: never."""
        self._low_v, self._sit_v = config.low_v, config.sit_v

    def advance(self, s: SupplyState, states: Sequence[JointState], dt: float) -> None:
        """Advance by one tick.

        Args:
            s: this watch's state, which changes.
            states: the newest of each module.
            dt: time since the last tick, s.
        """
        known = [(state.supply_v, at) for at, state in enumerate(states) if state.supply_v > 0.0]
        if not known:
            return
        lowest, at = min(known)
        s.volts = lowest if s.volts == 0.0 else s.volts + min(1.0, dt / POLE_S) * (lowest - s.volts)
        s.module = MODULES[at]
        s.low = s.volts < self._low_v + (RECOVERED_V if s.low else 0.0)
        s.was_well |= s.volts > self._low_v
        s.sits = s.was_well and s.volts < self._sit_v + (RECOVERED_V if s.sits else 0.0)

    def describe(self, s: SupplyState) -> str:
        """Return what the person must know; "" if the supplies are well."""
        if s.sits:
            return (
                f"the supply of {s.module} is at {s.volts:.1f} V, below {self._sit_v:g} V: it goes "
                "down; hang it, or put a stand under its torso, now"
            )
        if s.low:
            return (
                f"the supply of {s.module} is at {s.volts:.1f} V, below {self._low_v:g} V: change "
                f"the battery; at {self._sit_v:g} V it goes down by itself"
            )
        return ""
