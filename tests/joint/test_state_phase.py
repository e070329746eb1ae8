"""A joint service sends its states in the periods that its planner names."""

from __future__ import annotations

import itertools
import random

import pytest

from services.joint.controller import JointController
from shared.bus.messages import JointCommand
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import T0, Bench, command, with_service

PERIOD_NS = 2_000_000


def sent(
    robot: RobotConfig,
    commands: dict[int, JointCommand],
    *,
    late_ns: dict[int, int] | None = None,
    restored_at: int = -1,
    cycles: int = 400,
) -> list[int]:
    """Return the numbers of the periods in which a service sends a state.

    Args:
        robot: says how many periods there are from one state to the next.
        commands: by the period in which they come.
        late_ns: by period, how late the cycle is.
        restored_at: period before which another controller goes on from a snapshot.
        cycles: to run.
    """
    bench = Bench(robot)
    periods = []
    for number in range(1, cycles + 1):
        if number == restored_at:
            other = JointController(believing(robot), "knee_right")
            other.restore(bench.controller.snapshot())
            bench.controller = other
        bench.now_ns = T0 + number * PERIOD_NS + (late_ns or {}).get(number, 0)
        bench.controller.step(bench.now_ns, bench.reading(), commands.get(number), estop=False)
        if bench.controller.is_state_due:
            periods.append(number)
    return periods


def asked(phase: int, number: int) -> JointCommand:
    now_ns = T0 + number * PERIOD_NS
    return command(t_ns=now_ns, echo_t_ns=now_ns, seq=number, state_phase=phase)


@pytest.mark.parametrize("every", [1, 2, 4])
@pytest.mark.parametrize("phase", [0, 1, 2, 3, -1, 2**40 + 1])
def test_it_changes_to_the_phase_that_a_command_names_and_keeps_it(
    robot: RobotConfig, every: int, phase: int
) -> None:
    robot = with_service(robot, state_rate_hz=500.0 / every)
    periods = sent(robot, {101: asked(phase, 101)})
    before = [number for number in periods if number <= 100]
    after = [number for number in periods if number > 101 + every]
    assert {number % every for number in before} == {0}
    assert {number % every for number in after} == {phase % every}
    assert len(after) >= 299 // every - 1, "and none is left out, though no other command comes"


def test_the_first_after_a_restore_comes_as_it_would_have(robot: RobotConfig) -> None:
    commands = {101: asked(1, 101)}
    for restored_at in (100, 101, 102, 103, 250):
        assert sent(robot, commands, restored_at=restored_at) == sent(robot, commands)


def test_cycles_that_are_held_up_lose_no_state(robot: RobotConfig) -> None:
    """Late by more than half a period, a cycle counts as the next; the due one was left out."""
    dice = random.Random(2)
    late = {number: dice.randrange(1_000_000, 1_400_000) for number in range(5, 1000, 20)}
    periods = sent(robot, {}, late_ns=late, cycles=1000)
    assert len(periods) >= 499
    assert max(later - earlier for earlier, later in itertools.pairwise(periods)) <= 3
