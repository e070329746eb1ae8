"""What ROS 2 may ask for: within limits, and a stop that reaches all."""

from __future__ import annotations

import math
from itertools import product
from types import SimpleNamespace

import pytest

from services.ros2_gateway.inbound import (
    ESTOP,
    GIVE_UP_NS,
    INTENT,
    REPEAT_NS,
    SOURCE,
    STOPPED,
    Inbound,
    acceptable,
)
from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError
from tests.ros2_gateway.messages import planner_status

T0 = 10**9


def said(data: object) -> SimpleNamespace:
    return SimpleNamespace(data=data)


def test_an_intent_is_passed_on_once_with_its_force(robot: RobotConfig) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(80.0), T0)
    intent = inbound.intent(T0, 3, None)
    assert intent is not None
    assert (intent.assist_n, intent.seq, intent.source) == (80.0, 3, SOURCE)
    assert inbound.intent(T0, 4, None) is None


@pytest.mark.parametrize("past", [-1e-9, math.nan, math.inf, -math.inf, 1e308])
def test_a_force_that_cannot_be_given_is_refused_and_counted(
    robot: RobotConfig, past: float
) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(past), T0)
    inbound.receive(INTENT, None, T0)
    assert inbound.intent(T0, 0, None) is None
    assert inbound.refused == 2


@pytest.mark.parametrize("force", [0.0, 1.0])
def test_the_limits_themselves_are_accepted(robot: RobotConfig, force: float) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(force * robot.assist.force_max), T0)
    assert inbound.intent(T0, 0, None) is not None
    inbound.receive(INTENT, said(math.nextafter(robot.assist.force_max, math.inf)), T0)
    assert inbound.intent(T0, 0, None) is None


@pytest.mark.parametrize(
    ("by", "passes"), [("", True), (SCENARIO, True), (SOURCE, True), ("xrl assist by ann", False)]
)
def test_it_does_not_talk_another_operator_down(robot: RobotConfig, by: str, passes: bool) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(50.0), T0)
    found = inbound.intent(T0, 0, planner_status(requested_by=by))
    assert (found is not None) is passes
    assert inbound.refused == (not passes)


def test_only_true_stops(robot: RobotConfig) -> None:
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(False), T0)
    assert not inbound.stop_due(T0, [Mode.TRACK] * 6, 6)
    inbound.receive(ESTOP, said(True), T0)
    assert inbound.stop_due(T0, [Mode.TRACK] * 6, 6)
    inbound.receive(ESTOP, said(False), T0)
    assert inbound.stop_due(T0 + REPEAT_NS, [Mode.TRACK] * 6, 6), "nothing here ends a stop"


@pytest.mark.parametrize(("mode", "others"), list(product(Mode, [Mode.DAMP, Mode.TRACK])))
def test_a_stop_is_repeated_until_every_module_has_stopped(
    robot: RobotConfig, mode: Mode, others: Mode
) -> None:
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    modes = [mode, *[others] * 5]
    puts = sum(inbound.stop_due(T0 + k * REPEAT_NS, modes, 6) for k in range(10))
    stopped = mode in STOPPED and others in STOPPED
    assert puts == (1 if stopped else 10), "once in any case: a module may have been silent"


def test_a_module_that_is_silent_has_not_stopped_and_it_gives_up_in_the_end(
    robot: RobotConfig,
) -> None:
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    times = range(T0, T0 + 2 * GIVE_UP_NS, REPEAT_NS)
    puts = [at for at in times if inbound.stop_due(at, [Mode.DAMP] * 5, 6)]
    assert puts[-1] - T0 == GIVE_UP_NS


@pytest.mark.parametrize(
    ("words", "names"),
    [("intent", ("intent",)), ("estop", ("estop",)), ("intent,estop", ("intent", "estop"))],
)
def test_what_may_be_accepted(words: str, names: tuple[str, ...]) -> None:
    assert acceptable(words) == names


@pytest.mark.parametrize("words", ["", ",", "all", "estop,command", "ESTOP"])
def test_anything_else_is_one_clear_line(words: str) -> None:
    with pytest.raises(FleetError, match="intent or estop or intent,estop is right"):
        acceptable(words)
