"""Six modules whose cycles no clock ties together send their states close together."""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.planner.state_phases import (
    COMPARED_TICKS,
    EVERY_TICKS,
    SOON_TICKS,
    PhasesState,
    StatePhases,
)
from shared.bus.messages import JointState
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import N_MODULES
from tests.planner.states import Kept, state

RATE_HZ, STATE_HZ = 500.0, 250.0
CYCLE_NS = round(NS_PER_S / RATE_HZ)
STATE = state(0, np.zeros(12))


class Modules:
    """Six services: each with its own clock, count and phase."""

    def __init__(
        self,
        begin_ns: Sequence[int] = (0,) * N_MODULES,
        counts: Sequence[int] = (0,) * N_MODULES,
        *,
        n: int = 2,
        ppm: Sequence[float] = (0.0,) * N_MODULES,
        jitter_ns: int = 0,
    ) -> None:
        """Set when each begins and at which count, cycles per state, clock errors and jitter."""
        self.n, self.phases = n, [0] * N_MODULES
        self._begin_ns, self._first = begin_ns, counts
        self._cycle_ns = [CYCLE_NS * (1.0 + 1e-6 * error) for error in ppm]
        self._counts, self._dice, self._jitter_ns = list(counts), random.Random(1), jitter_ns

    def send(self, module: int) -> tuple[JointState, int]:
        """Return the module's next state and its arrival."""
        self._counts[module] += 1
        while (self._counts[module] - self.phases[module]) % self.n:
            self._counts[module] += 1
        count = self._counts[module]
        cycles = count - self._first[module]
        arrives = self._begin_ns[module] + cycles * self._cycle_ns[module]
        arrives += self._dice.uniform(0.0, self._jitter_ns)
        return msgspec.structs.replace(STATE, state_phase=self.phases[module]), round(arrives)

    def send_all(self) -> tuple[list[JointState], list[int]]:
        """Return the modules' next states and their arrivals."""
        states, arrived = zip(*map(self.send, range(N_MODULES)), strict=True)
        return list(states), list(arrived)


@pytest.fixture
def phases() -> Kept:
    return Kept(StatePhases(RATE_HZ, STATE_HZ), PhasesState())


def run(phases: Kept, modules: Modules, ticks: int, *, heard: bool = True) -> list[float]:
    """Return the spread of the arrivals of each tick, cycles."""
    spreads = []
    for _ in range(ticks):
        states, arrived = modules.send_all()
        phases.advance(states, arrived, min(arrived) - 1)
        if heard:
            modules.phases = list(phases.state.phases)
        period = modules.n * CYCLE_NS
        behind = [(a - arrived[0] + period / 2) % period - period / 2 for a in arrived]
        spreads.append((max(behind) - min(behind)) / CYCLE_NS)
    return spreads


@given(
    begin=st.lists(st.integers(0, 20 * CYCLE_NS), min_size=6, max_size=6),
    counts=st.lists(st.integers(0, 9), min_size=6, max_size=6),
    n=st.sampled_from([2, 3, 4]),
)
def test_after_one_comparison_all_are_close(begin: list[int], counts: list[int], n: int) -> None:
    phases = Kept(StatePhases(RATE_HZ, RATE_HZ / n), PhasesState())
    spreads = run(phases, Modules(begin, counts, n=n), COMPARED_TICKS + 20)
    assert max(spreads[-10:]) <= 1.0 + 2 * 0.15 + 1e-9


def test_jitter_of_a_cycle_moves_no_module_to_and_fro(phases: Kept) -> None:
    begin = [module * CYCLE_NS // 10 for module in range(N_MODULES)]
    modules = Modules(begin, jitter_ns=CYCLE_NS)
    seen = set()
    for _ in range(2500):
        run(phases, modules, 1)
        seen.add(tuple(phases.state.phases))
    assert seen == {(0,) * N_MODULES}


def test_drives_whose_clocks_drift_change_phase_once_for_each_cycle_they_drift(
    phases: Kept,
) -> None:
    modules = Modules(ppm=[0, 200, 0, 0, 0, 0])
    changes, last, spreads = 0, 0, []
    for _ in range(11_000):  # 44 s: 8.8 ms, four cycles and a bit
        spreads += run(phases, modules, 1)
        changes += phases.state.phases[1] != last
        last = phases.state.phases[1]
    assert changes == 4
    assert max(spreads) < 0.5 + 0.15 + 200e-6 * 2 * EVERY_TICKS + 0.05


def test_one_late_state_moves_nothing(phases: Kept) -> None:
    assert not phases.compares(), "before there are six modules"
    modules = Modules()
    run(phases, modules, 1)
    states, _ = modules.send_all()
    for late_ns in (1, CYCLE_NS, 100 * NS_PER_MS):
        phases.advance(states, [0, late_ns, 0, 0, 0, 0], -1)
    run(phases, modules, COMPARED_TICKS)
    assert phases.state.phases == [0] * N_MODULES


def test_a_new_planner_adopts_the_phases_that_the_last_one_left(phases: Kept) -> None:
    modules = Modules([0, CYCLE_NS, 0, 0, 0, 0])
    run(phases, modules, 250)
    left = list(modules.phases)
    new = Kept(StatePhases(RATE_HZ, STATE_HZ), PhasesState())
    assert max(run(new, modules, 500)) < 0.5
    assert new.state.phases == left == [0, 1, 0, 0, 0, 0]


@pytest.mark.parametrize("silent", [0, 3])
def test_while_a_module_is_silent_the_others_keep_their_phases(phases: Kept, silent: int) -> None:
    """Compared with what came last from it, long ago, they would all drift through all phases."""
    modules = Modules(ppm=[20, 40, 60, 80, 100, 0])
    run(phases, modules, COMPARED_TICKS)
    last = modules.send(silent)
    compared = 0
    for _ in range(20 * EVERY_TICKS):
        sent = [last if module == silent else modules.send(module) for module in range(N_MODULES)]
        others = [arrival for module, (_, arrival) in enumerate(sent) if module != silent]
        compared += phases.compares()
        phases.advance(*zip(*sent, strict=True), min(others) - 1)
        modules.phases = list(phases.state.phases)
    assert phases.state.phases == [0] * N_MODULES
    rounds = 20 * EVERY_TICKS // SOON_TICKS
    assert rounds - 1 <= compared / COMPARED_TICKS <= rounds, "between the comparisons it rests"


def begun_after(phases: Kept, modules: Modules, comparisons: int) -> list[int]:
    """Return the ticks from the begin of each comparison to that of the next."""
    begins, ticks, before = [], 0, True
    while len(begins) <= comparisons:
        run(phases, modules, 1)
        ticks += 1
        if phases.compares() and not before:
            begins.append(ticks)
        before = phases.compares()
    return [later - earlier for earlier, later in pairwise([0, *begins])]


@pytest.mark.parametrize("moved", [1, 5])
def test_what_is_settled_is_compared_ever_more_rarely_and_a_second_after_a_module_was_moved(
    phases: Kept, moved: int
) -> None:
    begin = [CYCLE_NS * (module == moved) for module in range(N_MODULES)]
    assert begun_after(phases, Modules(begin), 3) == [256, 512, 1024, 1024]
    settled = Kept(StatePhases(RATE_HZ, STATE_HZ), PhasesState())
    assert begun_after(settled, Modules(), 4) == [512, 1024, 1024, 1024, 1024]


def test_after_a_module_was_silent_it_is_compared_again_in_a_second(phases: Kept) -> None:
    modules = Modules()
    run(phases, modules, 512 - 1)
    for _ in range(COMPARED_TICKS):  # nothing new in all of the second
        states, arrived = modules.send_all()
        phases.advance(states, arrived, max(arrived))
    assert 150 < begun_after(phases, modules, 1)[0] <= 256


@pytest.mark.parametrize(("behind", "phase"), [(0.6, 0), (-0.6, 0), (0.7, 1), (-0.7, 1)])
def test_a_module_behind_by_half_a_period_and_a_bit_moves(
    phases: Kept, behind: float, phase: int
) -> None:
    begin = [round(CYCLE_NS * (10.0 + behind * (module == 2))) for module in range(N_MODULES)]
    run(phases, Modules(begin), COMPARED_TICKS)
    assert phases.state.phases == [0, 0, phase, 0, 0, 0]


def test_arrivals_in_all_phases_move_nothing_and_are_not_remembered(phases: Kept) -> None:
    every = Kept(StatePhases(RATE_HZ, RATE_HZ), PhasesState())  # nothing to choose
    run(every, Modules([0, 700_000, 0, 0, 0, 0], [0, 1, 2, 3, 4, 5], n=1), 500)
    assert every.state.phases == [0] * N_MODULES
    modules = Modules()
    run(phases, modules, 1)
    for tick in range(COMPARED_TICKS):
        states, arrived = modules.send_all()
        arrived[3] += tick % 8 * CYCLE_NS // 4
        phases.advance(states, arrived, min(arrived) - 1)
    assert phases.state.phases == [0] * N_MODULES
    assert phases.state.sums == [(0.0, 0.0)] * N_MODULES
