"""What the planner does before a motor is too warm or a battery is empty. Pure.

**Heat** (docs/law.md#heat). Each joint service says how many seconds are left at its present load.
By the least of them:

    below heat.ease_s     the person is told, and the assist goes, as far as nobody rests on it
    below heat.stand_s    height and pitch are the planner's: it stands up slowly, to nearly
                          straight knees, where a held pose costs least
    straight              it stays so for `REST_S`, until `RELEASE` times ease_s are left, and while
                          a hand presses or pulls it: given back, it would follow that at once

Without a planner the modules hold, and only say it.

**Supply.** A battery that runs low is told early:

    low      below `supply.low_v`: the person is told, with the number
    sits     below `supply.sit_v`: the robot goes down by itself
             (`services.planner.law.closed_reference`)

A supply without power makes its modules limp, and the robot falls: from its lowest pose as hard as
from a stand. Down, a stand can be put under the torso; that is what the time is for. The lowest
of the six counts, low-passed: a step of the load is no empty battery. Both last until the supply is
`RECOVERED_V` above their level, because a battery recovers as soon as its load is less.
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
"""Time in which all of the assist goes if nobody rests on it: 20 N/s of the full one."""
SHED_RATE: Final = 5.0
"""N/s with which it goes from under a person who takes weight off."""
RESTED_ON: Final = 5.0
"""N; the assist stays above what the person rests on it, less this; dry friction hides 6 N."""
STRAIGHT: Final = -0.4
"""rad, knees' theta: their soft stop is at -0.2, and a straight knee is singular."""
SLACK: Final = 0.15
"""rad by which a knee bends again before the robot goes on standing up."""
REST_S: Final = 20.0
"""Shortest time for which it stays straight."""
RELEASE: Final = 2.0
"""Times heat.ease_s that must be left before the height is the person's again."""
HAND_MAX: Final = 30.0
"""N beyond the assist, either way; with more on it the height is not given back. With 150 N on it a
robot fell from 1.29 to 0.95 m within a second."""
ASSIST_AGAIN: Final = 10.0
"""Times heat.ease_s that must be left before the assist comes back: with less it would come and
go, for the load is light while it is gone."""
_KNEES: Final = tuple(i for i, name in enumerate(MODULES) if kind_of(name) == "knee")


class HeatDecision(NamedTuple):
    """What a tick does against the heat."""

    assist: float
    """Assist that is requested of the law, N."""
    toward: Toward
    """Where it goes by itself."""


class HeatWatchState(msgspec.Struct):
    """State of `HeatWatch`."""

    action: HeatAction = HeatAction.NONE
    since_ns: int = 0
    """Since when the action is so."""
    scale: float = 1.0
    """Fraction of the requested assist that is left."""
    rests: float = 0.0
    """What the person rests on the robot, N; it falls by `SHED_RATE` at the most."""
    left_s: float = -1.0
    """Least of all modules; -1: none says."""
    lifted: float | None = None
    """Upward force of the person on the robot in the last tick, N; None: not known."""
    hottest: int = 0
    """Its module; while it rests, the one for which it stood up."""

    @property
    def moves(self) -> bool:
        """True while height and pitch are the planner's."""
        return self.action >= HeatAction.STANDS_UP


class HeatWatch:
    """Decides what is done against the heat."""

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
        """Advance by one tick.

        Args:
            s: this watch's state, which changes.
            now_ns: the planner's clock.
            states: newest of each module.
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
        """Return what is done against the heat, in words; "" if nothing."""
        if s.action is HeatAction.NONE:
            return ""
        name = MODULES[s.hottest]
        if s.action is HeatAction.RESTS and s.left_s < self._ease_s:
            return f"{name} is hot, {s.left_s:.0f} s left even straight: take load off, or hang it"
        if s.action is HeatAction.RESTS:
            return f"{name} was hot: it stays straight until it has cooled, and no hand presses it"
        words = "stand up, or take weight off; the assist goes"
        if s.action is HeatAction.STANDS_UP:
            words = "it stands up by itself; let it"
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
    """Return what is left of the requested assist, N."""
    if s.scale >= 1.0:
        return requested
    return min(requested, max(s.scale * requested, s.rests - RESTED_ON))


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
