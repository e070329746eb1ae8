"""The planner looks for states soon enough, and is not late because it was late once."""

from __future__ import annotations

import random
from types import SimpleNamespace
from typing import cast

import pytest

from services.planner.loop import FOLLOW_NS, POLL_NS, PlannerLoop, PlannerPorts
from services.planner.planner import Planner
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig

PERIOD_NS = 4 * NS_PER_MS


class Looking:
    """A planner's loop in virtual time, and states that are complete at given times."""

    def __init__(self, robot: RobotConfig, *, compares: bool = False) -> None:
        """Begin at 1 s."""
        planner = cast(Planner, SimpleNamespace(compares_arrivals=compares))
        self.loop = PlannerLoop(robot, planner, cast(PlannerPorts, None))
        self.now_ns, self.polls = NS_PER_S, 0

    def tick_at(self, complete_ns: int, held_up_ns: int = 0) -> int:
        """Look until the states are complete, and tick; return how late that is, ns."""
        while self.now_ns < complete_ns:
            self.now_ns += POLL_NS
            self.polls += 1
        self.now_ns += held_up_ns
        late_ns = self.now_ns - complete_ns
        self.now_ns = max(self.now_ns, self.loop._rests_until(self.now_ns))
        return late_ns


def test_states_that_come_every_period_wait_for_no_longer_than_a_poll(robot: RobotConfig) -> None:
    looking, dice = Looking(robot), random.Random(1)
    late = []
    for tick in range(500):
        jitter_ns = dice.randrange(200_000)
        late.append(looking.tick_at(NS_PER_S + tick * PERIOD_NS + jitter_ns))
    assert max(late) <= POLL_NS + FOLLOW_NS
    assert looking.polls < 5 * 500, "between two ticks it rests"


@pytest.mark.parametrize("held_up_ns", [NS_PER_MS, 2 * NS_PER_MS, 3 * NS_PER_MS])
def test_a_tick_that_was_held_up_makes_no_later_one_late(
    robot: RobotConfig, held_up_ns: int
) -> None:
    looking = Looking(robot)
    for tick in range(100):
        late_ns = looking.tick_at(NS_PER_S + tick * PERIOD_NS, held_up_ns if tick == 50 else 0)
        assert late_ns <= POLL_NS + FOLLOW_NS or tick == 50


def test_after_a_long_gap_it_rests_again(robot: RobotConfig) -> None:
    looking = Looking(robot)
    looking.tick_at(NS_PER_S)
    looking.tick_at(3 * NS_PER_S)
    before = looking.polls
    for tick in range(1, 50):
        looking.tick_at(3 * NS_PER_S + tick * PERIOD_NS)
    assert looking.polls - before < 5 * 50


def test_while_arrivals_are_compared_it_does_not_rest(robot: RobotConfig) -> None:
    looking = Looking(robot, compares=True)
    looking.tick_at(NS_PER_S)
    assert looking.loop._rests_until(looking.now_ns) == looking.now_ns + POLL_NS
