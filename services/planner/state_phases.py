"""Choice of the periods in which modules send their states, so that all six arrive together. Pure.

A module sends its state every nth period of its drive (n = 2: 500 Hz and 250 Hz). If the modules
send in different periods, each tick waits for the last of them (docs/architecture.md#rates). The
planner compares the states' arrivals with the first module's. Each command names the period in
which the module sends its next state (`JointCommand.state_phase`). Without a command in time, a
module keeps its phase.

A comparison takes `COMPARED_TICKS` and starts every `SOON_TICKS` to `EVERY_TICKS`. Only then does
the planner's loop poll continuously; otherwise it sleeps until states are due, so an early state
would look late.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import JointState, Pair
from shared.clock import NS_PER_S
from shared.joints import N_MODULES

EVERY_TICKS: Final = 1024
"""Maximum number of ticks between two comparisons: 4 s, in which two drives' clocks drift apart by
at most a fifth of a period (100 ppm)."""
COMPARED_TICKS: Final = 64
"""Ticks of a comparison: a quarter of a second, so that a single late message changes no period."""
SOON_TICKS: Final = 256
"""Ticks until the next comparison after a module changed its period or was silent: a second."""
SURE: Final = 0.5
"""Minimum length of a module's mean (cos, sin), 0 .. 1, for its period to change; arrivals spread
evenly over all phases give 0."""
HYSTERESIS: Final = 0.15
"""Fraction of a period beyond half a period at which a module changes its period. The drives'
clocks drift past one another. Without this margin, a phase would flap at the boundary."""


class PhasesState(msgspec.Struct):
    """State of `StatePhases`."""

    phases: list[int] = []
    """Period number modulo n in which each module sends its state; empty before the first tick."""
    tick: int = 0
    """Ticks since the last comparison started."""
    every: int = SOON_TICKS
    """Ticks from the start of one comparison to the next."""
    sums: list[Pair] = msgspec.field(default_factory=lambda: [(0.0, 0.0)] * N_MODULES)
    """Sum of (cos, sin) of 2 pi d / n for each module, whose states arrive d periods behind the
    first module's."""


class StatePhases:
    """Chooses the phases of the six modules."""

    def __init__(self, rate_hz: float, state_rate_hz: float) -> None:
        self._n = round(rate_hz / state_rate_hz)
        self._radians_per_ns = 2.0 * math.pi * state_rate_hz / NS_PER_S

    def compares(self, state: PhasesState) -> bool:
        """Return True if the next tick's arrivals are compared, so the loop must not sleep."""
        return self._n > 1 and bool(state.phases) and state.tick < COMPARED_TICKS

    def advance(
        self,
        state: PhasesState,
        states: Sequence[JointState],
        arrived_ns: Sequence[int],
        last_tick_ns: int,
    ) -> None:
        """Advance by one tick: compare arrivals if all six states are new; finally choose phases.

        Args:
            state: state of the phases; updated in place.
            states: newest states of the six modules.
            arrived_ns: their arrival times on the planner's clock.
            last_tick_ns: time of the previous tick.
        """
        n, first_ns = self._n, arrived_ns[0]
        if not state.phases:  # start from the last planner's phases
            state.phases = [one.state_phase % n for one in states]
        compares = self.compares(state) and state.tick > 0  # the loop slept before tick 0
        state.tick = (state.tick + 1) % state.every
        if not compares:
            return
        if min(arrived_ns) > last_tick_ns:
            for module, (x, y) in enumerate(state.sums):
                angle = self._radians_per_ns * (arrived_ns[module] - first_ns)
                state.sums[module] = (x + math.cos(angle), y + math.sin(angle))
        if not self.compares(state):
            self._decide(state, states)

    def _decide(self, own: PhasesState, states: Sequence[JointState]) -> None:
        """Choose the phases and when to compare next: soon after a change or a silent module."""
        n, count = self._n, COMPARED_TICKS - 1
        settled = True
        for module, (state, (x, y)) in enumerate(zip(states, own.sums, strict=True)):
            behind = n / (2.0 * math.pi) * math.atan2(y, x)
            # a module in another phase has not received its new phase yet
            told = state.state_phase % n == own.phases[module]
            sure = math.hypot(x, y) > SURE * count
            settled &= sure
            if told and sure and abs(behind) > 0.5 + HYSTERESIS:
                own.phases[module] = (own.phases[module] - round(behind)) % n
                settled = False
        own.sums = [(0.0, 0.0)] * N_MODULES
        own.every = min(EVERY_TICKS, 2 * own.every) if settled else SOON_TICKS
