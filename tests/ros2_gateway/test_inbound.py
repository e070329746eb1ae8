"""What ROS 2 may ask for: within limits, and a stop that reaches all."""

from __future__ import annotations

import math
from itertools import product
from types import SimpleNamespace

import msgspec
import pytest

from services.ros2_gateway.inbound import (
    GIVE_UP_NS,
    REPEAT_NS,
    SOURCE,
    Inbound,
    acceptable,
    inbound_topics,
)
from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError
from tests.messages import planner_status

T0 = 10**9
ESTOP, INTENT = inbound_topics("")


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
    ("by", "passes"), [("", True), (SCENARIO, True), (SOURCE, True), ("xrl lead by ann", False)]
)
def test_it_does_not_talk_another_operator_down(robot: RobotConfig, by: str, passes: bool) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(50.0), T0)
    found = inbound.intent(T0, 0, planner_status(requested_by=by))
    assert (found is not None) is passes
    assert inbound.refused == (not passes)


def heard(at_ns: int, *modes: Mode) -> list[tuple[int, int]]:
    return [(at_ns, int(mode)) for mode in modes]


def test_only_true_stops(robot: RobotConfig) -> None:
    inbound = Inbound(robot)
    tracking = heard(T0, *[Mode.TRACK] * 6)
    inbound.receive(ESTOP, said(False), T0)
    assert not inbound.stop_due(T0, tracking, 6)
    inbound.receive(ESTOP, said(True), T0)
    assert inbound.stop_due(T0, tracking, 6)
    inbound.receive(ESTOP, said(False), T0)
    assert inbound.stop_due(T0 + REPEAT_NS, tracking, 6), "nothing here ends a stop"


@pytest.mark.parametrize(("mode", "others"), list(product(Mode, [Mode.DAMP, Mode.TRACK])))
def test_a_stop_is_repeated_until_every_module_has_stopped(
    robot: RobotConfig, mode: Mode, others: Mode
) -> None:
    """One that is DISARMED may arm a moment later: it has not stopped."""
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    puts = 0
    for k in range(10):
        now = T0 + k * REPEAT_NS
        puts += inbound.stop_due(now, heard(now, mode, *[others] * 5), 6)
    stopped = mode in (Mode.DAMP, Mode.FAULT) and others is Mode.DAMP
    assert puts == (1 if stopped else 10), "once in any case: a module may have been silent"
    assert not inbound.not_stopped


def test_what_was_heard_before_the_request_does_not_count(robot: RobotConfig) -> None:
    """Its link was cut; it may have armed since."""
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    old = heard(T0 - 1, *[Mode.DAMP] * 6)
    assert all(inbound.stop_due(T0 + k * REPEAT_NS, old, 6) for k in range(10))


def test_a_module_that_is_silent_has_not_stopped_and_giving_up_is_told(robot: RobotConfig) -> None:
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    times = range(T0, T0 + 2 * GIVE_UP_NS, REPEAT_NS)
    puts = [at for at in times if inbound.stop_due(at, heard(at, *[Mode.DAMP] * 5), 6)]
    assert puts[-1] - T0 == GIVE_UP_NS
    assert inbound.not_stopped
    inbound.receive(ESTOP, said(True), T0)
    assert not inbound.not_stopped, "until it is asked for again"


def test_in_a_namespace_another_robots_requests_are_not_this_ones(robot: RobotConfig) -> None:
    ros2 = msgspec.structs.replace(robot.ros2, namespace="a")
    inbound = Inbound(msgspec.structs.replace(robot, ros2=ros2))
    assert inbound_topics("a").estop.name == "/a/xrl/estop"
    inbound.receive(inbound_topics("a").estop, said(True), T0)
    assert inbound.stop_due(T0, heard(T0, *[Mode.TRACK] * 6), 6)


@pytest.mark.parametrize(
    ("words", "names"),
    [("intent", ("intent",)), ("estop", ("estop",)), ("intent,estop", ("estop", "intent"))],
)
def test_what_may_be_accepted(words: str, names: tuple[str, ...]) -> None:
    assert acceptable(words) == names


@pytest.mark.parametrize("words", ["", ",", "all", "estop,command", "ESTOP"])
def test_anything_else_is_one_clear_line(words: str) -> None:
    with pytest.raises(FleetError, match="intent or estop or intent,estop is right"):
        acceptable(words)
