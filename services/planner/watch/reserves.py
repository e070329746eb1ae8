"""Actions before a motor overheats or a battery is empty. Pure.

**Heat** (docs/law.md#heat). Each joint service reports the seconds left at its present load. The
shortest time decides whether the assist ramps down, and whether the robot stands up to nearly
straight knees, where holding a pose costs least.

**Supply.** The planner warns early of a low battery:

    low      below `supply.low_v`: warn the wearer, with the voltage
    sits     below `supply.sit_v`: lower the robot (`services.planner.law.closed_reference`)

A supply without power makes its modules limp, and the robot falls: from its lowest pose as hard as
from a stand. The early lowering leaves time to put a stand under the torso. The lowest of the six
supplies counts, low-passed, because a voltage step under load does not mean an empty battery. Both
states last until the supply is `RECOVERED_V` above their level, because a battery recovers once its
load falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec

from services.planner.law.closed_reference import Toward
from shared.bus.messages import HeatAction, JointState
from shared.clamp import clamp
from shared.clock import NS_PER_S
from shared.config.sections import HeatConfig, SupplyConfig
from shared.joints import MODULES, kind_of

EASE_S: Final = 10.0
"""Time in which the whole assist fades if nobody rests on it, s: 20 N/s for the maximum of 200
N."""
SHED_RATE: Final = 5.0
"""Maximum rate at which the assist follows a person who takes weight off, N/s."""
RESTED_ON: Final = 5.0
"""N; the assist stays above the weight on the harness minus this. Dry friction hides 6 N."""
STRAIGHT: Final = -0.4
"""rad, theta of the knees; their soft stop is at -0.2, and a straight knee is singular."""
SLACK: Final = 0.15
"""rad; if a knee bends again by this, the robot resumes standing up."""
REST_S: Final = 20.0
"""Minimum time for which the robot stays straight, s."""
RELEASE: Final = 2.0
"""Multiple of heat.ease_s that must be left before the height opens again."""
HAND_MAX: Final = 30.0
"""N beyond the assist, either way; a stronger hand keeps the height closed. A robot whose height
opened under 150 N dropped from 1.29 to 0.95 m within a second."""
ASSIST_AGAIN: Final = 10.0
"""Multiple of heat.ease_s that must be left before the assist returns. With less, the assist would
come and go, because the load is light without it."""
_KNEES: Final = tuple(i for i, name in enumerate(MODULES) if kind_of(name) == "knee")


class HeatDecision(NamedTuple):
    """Action against the heat in one tick."""

    assist: float
    """Assist to request from the law, N."""
    toward: Toward
    """Direction in which the robot moves on its own."""


class HeatWatchState(msgspec.Struct):
    """State of `HeatWatch`."""

    action: HeatAction = HeatAction.NONE
    since_ns: int = 0
    """Time at which the action started."""
    scale: float = 1.0
    """Fraction of the requested assist that remains."""
    rests: float = 0.0
    """Weight that the person rests on the robot, N; falls at most at `SHED_RATE`."""
    left_s: float = -1.0
    """Shortest of the modules' times left, s; -1 if no module reports one."""
    lifted: float | None = None
    """Upward force of the person on the robot in the last tick, N; None if unknown."""
    hottest: int = 0
    """Module of `left_s`; while height and pitch are closed, updated only below `heat.ease_s`."""

    @property
    def moves(self) -> bool:
        """True while height and pitch are closed for heat."""
        return self.action >= HeatAction.STANDS_UP


class HeatWatch:
    """Decision on the action against the heat."""

    def __init__(self, config: HeatConfig) -> None:
        self._ease_s, self._stand_s = config.ease_s, config.stand_s

    def advance(
        self,
        s: HeatWatchState,
        now_ns: int,
        states: Sequence[JointState],
        requested: float,
        dt: float,
    ) -> HeatDecision:
        """Advance by one tick; return the action.

        Args:
            s: state of this watch; updated in place.
            now_ns: the planner's clock.
            states: newest state of each module.
            requested: assist that the operator requests, N.
            dt: time since the last tick, s.
        """
        lifted = s.lifted
        lefts = [state.heat_left_s for state in states]
        known = [left for left in lefts if left >= 0.0]
        s.left_s = min(known, default=-1.0)
        if known and (not s.moves or s.left_s < self._ease_s):
            s.hottest = lefts.index(s.left_s)
        quiet = lifted is not None and abs(lifted + _assist_left(s, requested)) <= HAND_MAX
        action = self._next(s, now_ns, states, quiet=quiet) if known else HeatAction.NONE
        if action is not s.action:
            s.action, s.since_ns = action, now_ns
        step = dt / EASE_S
        s.scale = clamp(s.scale + (step if action is HeatAction.NONE else -step), 0.0, 1.0)
        rests = 0.0 if lifted is None else -lifted
        s.rests = max(0.0, rests, s.rests - SHED_RATE * dt)
        toward = Toward.PERSON
        if s.moves:
            toward = Toward.UP if action is HeatAction.STANDS_UP else Toward.REST
        return HeatDecision(_assist_left(s, requested), toward)

    def describe(self, s: HeatWatchState) -> str:
        """Return a message about the action against the heat; "" without an action."""
        if s.action is HeatAction.NONE:
            return ""
        name = MODULES[s.hottest]
        if s.action is HeatAction.RESTS and s.left_s < self._ease_s:
            left = f"{s.left_s:.0f} s left even on straight legs"
            return f"{name} is hot, {left}: unload or hang the robot"
        if s.action is HeatAction.RESTS:
            until = "the module has cooled, and no hand presses or pulls"
            return f"{name} was hot: the robot stays straight until {until}"
        words = "stand up, or take weight off; the assist ramps down"
        if s.action is HeatAction.STANDS_UP:
            words = "the robot stands up on its own; let it"
        return f"{name} is hot, {s.left_s:.0f} s left at this load: {words}"

    def _next(
        self, s: HeatWatchState, now_ns: int, states: Sequence[JointState], *, quiet: bool
    ) -> HeatAction:
        knee = min(states[i].q[1] for i in _KNEES)
        if s.action is HeatAction.RESTS:
            rested = now_ns - s.since_ns >= REST_S * NS_PER_S
            if rested and quiet and s.left_s >= RELEASE * self._ease_s:
                return HeatAction.NONE
            return HeatAction.STANDS_UP if knee < STRAIGHT - SLACK else HeatAction.RESTS
        if s.action is HeatAction.STANDS_UP:
            return HeatAction.RESTS if knee >= STRAIGHT else HeatAction.STANDS_UP
        if s.left_s < self._stand_s:
            return HeatAction.STANDS_UP if knee < STRAIGHT else HeatAction.RESTS
        limit = self._ease_s * (ASSIST_AGAIN if s.action is HeatAction.EASES else 1.0)
        return HeatAction.EASES if s.left_s < limit else HeatAction.NONE


def _assist_left(s: HeatWatchState, requested: float) -> float:
    if s.scale >= 1.0:
        return requested
    return min(requested, max(s.scale * requested, s.rests - RESTED_ON))


POLE_S: Final = 2.0
"""Time constant, s."""
RECOVERED_V: Final = 1.0


class SupplyState(msgspec.Struct):
    """State of `SupplyWatch`."""

    volts: float = 0.0
    """Lowest supply, low-passed, V; 0 if unknown."""
    module: str = ""
    """Module of the lowest supply."""
    was_well: bool = False
    """True once the supply was above `supply.low_v`. A battery that was never above it is not the
    one that the robot file describes, so it does not lower the robot."""
    low: bool = False
    sits: bool = False


class SupplyWatch:
    """Comparison of the lowest supply with its levels."""

    def __init__(self, config: SupplyConfig) -> None:
        """Set the levels, V; 0 disables a level."""
        self._low_v, self._sit_v = config.low_v, config.sit_v

    def advance(self, s: SupplyState, states: Sequence[JointState], dt: float) -> None:
        """Advance by one tick.

        Args:
            s: state of this watch; updated in place.
            states: newest state of each module.
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
        """Return a warning for the wearer; "" if no supply is low."""
        if s.sits:
            return (
                f"the supply of {s.module} is at {s.volts:.1f} V (limit {self._sit_v:g} V): the "
                "robot goes down; hang it, or put a stand under its torso, now"
            )
        if s.low:
            goes = ""
            if self._sit_v and s.was_well:
                goes = f"; at {self._sit_v:g} V the robot goes down on its own"
            return (
                f"the supply of {s.module} is at {s.volts:.1f} V (limit {self._low_v:g} V): change "
                f"the battery{goes}"
            )
        return ""
