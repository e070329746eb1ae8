"""Periods are counted, not samples, and states are sent in the periods that the planner names."""

from __future__ import annotations

import itertools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.joint_estimate import SampleClock
from shared.bus.messages import JointCommand
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import ROBOT, T0, Bench, command, with_service

PERIOD_NS = 2 * NS_PER_MS


def counted(times_ns: list[int]) -> list[int]:
    clock, counts = SampleClock(), []
    for now_ns in times_ns:
        clock.advance(now_ns, PERIOD_NS)
        counts.append(clock.count)
    return counts


@given(
    seed=st.integers(0, 1000),
    ppm=st.floats(-200.0, 200.0),
    late=st.floats(0.0, 0.45),
    lost=st.floats(0.0, 0.2),
)
def test_periods_are_counted_late_or_lost(seed: int, ppm: float, late: float, lost: float) -> None:
    dice = random.Random(seed)
    numbers = [0, *(number for number in range(1, 2000) if dice.random() >= lost)]
    period = PERIOD_NS * (1.0 + 1e-6 * ppm)
    times = [NS_PER_S + round(period * (n + dice.uniform(0.0, late))) for n in numbers]
    times[0] = NS_PER_S
    assert counted(times) == [number + 1 for number in numbers]


@pytest.mark.parametrize("held_up_ns", [3 * NS_PER_MS, 9 * NS_PER_MS, NS_PER_S])
def test_after_a_service_was_held_up_the_count_goes_on_as_if_it_had_not(held_up_ns: int) -> None:
    times = [NS_PER_S + number * PERIOD_NS for number in range(100)]
    late = [now_ns for now_ns in times if now_ns <= times[50] or now_ns > times[50] + held_up_ns]
    late.append(times[50] + held_up_ns)
    expected = {now_ns: (now_ns - NS_PER_S) // PERIOD_NS + 1 for now_ns in times}
    for now_ns, count in zip(sorted(late), counted(sorted(late)), strict=True):
        if now_ns in expected:
            assert count == expected[now_ns]


def test_a_sample_half_a_period_late_counts_as_the_next() -> None:
    for late, count in ((0.45, 2), (0.55, 3), (1.45, 3), (1.55, 4)):
        assert counted([NS_PER_S, NS_PER_S + round((1.0 + late) * PERIOD_NS)]) == [1, count]


@pytest.mark.parametrize("phase", [0, 1, 2, 3])
@pytest.mark.parametrize("every", [1, 2, 4])
@pytest.mark.parametrize("rate", [1, 2, 3])
@pytest.mark.parametrize("twice", [True, False])
def test_each_due_period_passes_once_despite_losses(
    every: int, phase: int, rate: int, twice: bool
) -> None:
    """With a drive that sends at a half or a third of the rate, no sample meets it exactly.

    Two samples within a period begin one.
    """
    clock, passed = SampleClock(), 0
    for number in range(0, 1200, rate):
        for soon_ns in (0, 100_000) if twice else (0,):
            clock.advance(NS_PER_S + number * PERIOD_NS + soon_ns, PERIOD_NS)
            passed += clock.passed(every, phase % every)
    assert abs(passed - 1200 / max(every, rate)) <= 2
    assert rate > 1 or clock.count == 1200


# ---- states are sent in the periods that the planner names


def sent(
    commands: dict[int, JointCommand], *, late_ns: dict[int, int] | None = None, cycles: int = 400,
    robot: RobotConfig = ROBOT,
) -> list[int]:  # fmt: skip
    """Return the numbers of the periods in which a service sends a state.

    Commands come, and cycles are late, by period.
    """
    bench, periods = Bench(robot), []
    for number in range(1, cycles + 1):
        bench.now_ns = T0 + number * PERIOD_NS + (late_ns or {}).get(number, 0)
        bench.law.step(
            bench.controller, bench.now_ns, bench.reading(), commands.get(number), estop=False
        )
        if bench.law.is_state_due(bench.controller):
            periods.append(number)
    return periods


def asked(phase: int, number: int) -> JointCommand:
    now_ns = T0 + number * PERIOD_NS
    return command(t_ns=now_ns, echo_t_ns=now_ns, seq=number, state_phase=phase)


@pytest.mark.parametrize("every", [1, 2, 4])
@pytest.mark.parametrize("phase", [0, 1, 2, 3, -1, 2**40 + 1])
def test_it_keeps_the_phase_that_a_command_names(every: int, phase: int) -> None:
    robot = with_service(ROBOT, state_rate_hz=500.0 / every)
    periods = sent({101: asked(phase, 101)}, robot=robot)
    before = [number for number in periods if number <= 100]
    after = [number for number in periods if number > 101 + every]
    assert {number % every for number in before} == {0}
    assert {number % every for number in after} == {phase % every}
    assert len(after) >= 299 // every - 1, "and none is left out, though no other command comes"


def test_cycles_that_are_held_up_lose_no_state() -> None:
    """Late by more than half a period, a cycle counts as the next; the due one was left out."""
    dice = random.Random(2)
    late = {number: dice.randrange(1_000_000, 1_400_000) for number in range(5, 1000, 20)}
    periods = sent({}, late_ns=late, cycles=1000)
    assert len(periods) >= 499
    assert max(later - earlier for earlier, later in itertools.pairwise(periods)) <= 3
