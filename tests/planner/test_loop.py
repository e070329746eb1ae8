"""The planner looks for states soon enough, and is not late because it was late once."""

from __future__ import annotations

import random
from types import SimpleNamespace
from typing import cast

import pytest

from services.planner.loop import FOLLOW_NS, POLL_NS, PlannerLoop, PlannerPorts
from services.planner.planner import Planner
from shared.clock import NS_PER_MS, NS_PER_S
from tests.planner.states import ROBOT

PERIOD_NS = 4 * NS_PER_MS


class Looking:
    """A planner's loop in virtual time, and six states that are complete at given times."""

    def __init__(self, *, compares: bool = False) -> None:
        """Begin at 1 s."""
        planner = cast(Planner, SimpleNamespace(compares_arrivals=compares))
        self.loop = PlannerLoop(ROBOT, planner, cast(PlannerPorts, None))
        self.now_ns, self.polls, self._ticked_ns = NS_PER_S, 0, 0

    def tick_at(self, complete_ns: int, held_up_ns: int = 0) -> int:
        """Look until the states are complete, and tick; return how late that is, ns."""
        while self.now_ns < max(complete_ns, self._ticked_ns + PERIOD_NS // 2):
            self.now_ns = self.loop._next_look(self.now_ns, ticked=False)
            self.polls += 1
        self.now_ns += held_up_ns
        late_ns, self._ticked_ns = self.now_ns - complete_ns, self.now_ns
        self.now_ns = self.loop._next_look(self.now_ns, ticked=True)
        return late_ns


def test_states_that_come_every_period_wait_for_no_longer_than_a_poll() -> None:
    looking, dice = Looking(), random.Random(1)
    late = []
    for tick in range(500):
        jitter_ns = dice.randrange(200_000)
        late.append(looking.tick_at(NS_PER_S + tick * PERIOD_NS + jitter_ns))
    assert max(late) <= POLL_NS + FOLLOW_NS
    assert looking.polls < 5 * 500, "between two ticks it rests"


@pytest.mark.parametrize("held_up_ns", [NS_PER_MS, 2 * NS_PER_MS, 3 * NS_PER_MS, 8 * NS_PER_MS])
def test_after_a_late_tick_they_are_soon_in_time(held_up_ns: int) -> None:
    looking = Looking()
    for tick in range(100):
        late_ns = looking.tick_at(NS_PER_S + tick * PERIOD_NS, held_up_ns if tick == 50 else 0)
        assert late_ns <= POLL_NS + FOLLOW_NS or 50 <= tick <= 50 + 2 * held_up_ns // PERIOD_NS + 1


@pytest.mark.parametrize("busy_ns", [NS_PER_MS, 3 * NS_PER_MS // 2])
def test_kept_from_looking_it_does_not_stay_late(busy_ns: int) -> None:
    """They run for a while before the states are complete; it then found those of a period ago."""
    loop = Looking().loop
    complete = [NS_PER_S + tick * PERIOD_NS for tick in range(100)]
    now_ns, taken, ages = complete[1] - 100_000, 0, []
    ticked_ns = 0
    while taken < 90:
        newest = (now_ns - NS_PER_S) // PERIOD_NS
        ticked = newest > taken and now_ns - ticked_ns >= PERIOD_NS // 2
        if ticked or (not ages and newest >= 0):
            ticked, taken, ticked_ns = True, max(taken, newest), now_ns
            ages.append(now_ns - complete[newest])
        now_ns = loop._next_look(now_ns, ticked=ticked)
        until_ns = PERIOD_NS - (now_ns - NS_PER_S) % PERIOD_NS
        if 100_000 < until_ns < busy_ns:  # kept until just before the next are complete
            now_ns += until_ns - 100_000
    assert ages[0] > 3 * NS_PER_MS, "it began a period late"
    assert max(ages[5:]) <= 2 * POLL_NS


def test_after_a_long_gap_it_rests_again() -> None:
    looking = Looking()
    looking.tick_at(NS_PER_S)
    looking.tick_at(3 * NS_PER_S)
    before = looking.polls
    for tick in range(1, 50):
        looking.tick_at(3 * NS_PER_S + tick * PERIOD_NS)
    assert looking.polls - before < 5 * 50


def test_while_arrivals_are_compared_it_does_not_rest() -> None:
    looking = Looking(compares=True)
    looking.tick_at(NS_PER_S)
    assert looking.loop._next_look(looking.now_ns, ticked=True) == looking.now_ns + POLL_NS
