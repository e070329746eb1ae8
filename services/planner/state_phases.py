"""Chooses in which of its cycles each module sends its state, so that the six come together. Pure.

A module sends its state every nth cycle (n = 2: 500 Hz and 250 Hz). The modules' cycles follow
their drives, which no clock ties together, and their counts begin at different times. If one sends
in its even cycles what the others send in their odd ones, each tick waits for it, and uses five
states that are a cycle older than they need be. The planner compares the states' arrivals with the
first module's, and names in each command the cycle in which the next state is to be sent
(`JointCommand.state_phase`). A late command, or none, changes nothing: a module keeps its phase.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from services.planner.snapshots import PhasesState
from shared.bus.messages import JointState, Pair
from shared.clock import NS_PER_S
from shared.robot.joints import N_MODULES

FOLLOW_FRACTION: Final = 1.0 / 64.0
"""Of a new arrival in a module's mean: a quarter of a second at 250 Hz, so that no single late
message moves a module."""
SURE: Final = 0.5
"""Length of a mean from which it counts, 0 .. 1: an even spread over all phases has 0, and so has a
mean that has just begun."""
HYSTERESIS: Final = 0.15
"""Of a cycle, beyond half a cycle: the drives' clocks drift past one another, and a phase is not to
change to and fro."""


class StatePhases:
    """Phases of six modules.

    Attributes:
        phases: of each module: it is to send its state in cycles of this number modulo n.
    """

    def __init__(self, rate_hz: float, state_rate_hz: float) -> None:
        """Set the rates of the modules' cycles and of their states, Hz."""
        self._n = round(rate_hz / state_rate_hz)
        self._radians_per_ns = 2.0 * math.pi * state_rate_hz / NS_PER_S
        self._behind: list[Pair] = [(0.0, 0.0)] * N_MODULES
        self.phases: list[int] = []

    def advance(self, states: Sequence[JointState], arrived_ns: Sequence[int]) -> None:
        """Compare the states of a tick.

        Args:
            states: of the six modules.
            arrived_ns: their arrivals, by the planner's clock.
        """
        n, first_ns = self._n, arrived_ns[0]
        if not self.phases:  # as the last planner left them
            self.phases = [state.cycle % n for state in states]
        if n == 1:
            return
        for module, state in enumerate(states):
            if state.cycle % n != self.phases[module]:
                continue  # it has not heard yet
            angle = self._radians_per_ns * (arrived_ns[module] - first_ns)
            x, y = self._behind[module]
            x += FOLLOW_FRACTION * (math.cos(angle) - x)
            y += FOLLOW_FRACTION * (math.sin(angle) - y)
            cycles = n / (2.0 * math.pi) * math.atan2(y, x)
            if math.hypot(x, y) > SURE and abs(cycles) > 0.5 + HYSTERESIS:
                self.phases[module] = (self.phases[module] - round(cycles)) % n
                x = y = 0.0
            self._behind[module] = (x, y)

    def snapshot(self) -> PhasesState:
        """Return the state."""
        return PhasesState(tuple(self.phases), tuple(self._behind))

    def restore(self, state: PhasesState) -> None:
        """Continue from a state."""
        self.phases = list(state.phases)
        self._behind = list(state.behind) or [(0.0, 0.0)] * N_MODULES
