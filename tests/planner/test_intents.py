"""An intent is given while it is heard, and fades out when it is not."""

from __future__ import annotations

import math

import pytest

from services.planner.intents import Intents, OperatorRequest
from shared.bus.messages import STRAIGHT, OperatorIntent, Vector4
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig

T0 = 5_000_000_000


def intent(assist_n: float, shift: Vector4 = STRAIGHT) -> OperatorIntent:
    return OperatorIntent(t_ns=1, seq=1, assist_n=assist_n, shift=shift, source="a test")


def late_ns(robot: RobotConfig, share: float) -> int:
    """Return when so much of the fade is over."""
    assist = robot.assist
    return T0 + round(assist.stale_ms * NS_PER_MS + share * assist.fade_s * 1e9)


def test_without_an_intent_nothing_is_requested(robot: RobotConfig) -> None:
    assert Intents(robot.assist).request(T0) == OperatorRequest(0.0, STRAIGHT, "")


def test_a_message_is_given_until_it_is_stale(robot: RobotConfig) -> None:
    intents = Intents(robot.assist)
    intents.receive(intent(80.0, (0.01, 0.0, 0.0, -0.02)), T0)
    for now in (T0, T0 + 1, late_ns(robot, 0.0)):
        assert intents.request(now) == OperatorRequest(80.0, (0.01, 0.0, 0.0, -0.02), "a test")


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0, 1.5, 1000.0])
def test_then_it_fades_to_nothing_and_stays_there(robot: RobotConfig, share: float) -> None:
    intents = Intents(robot.assist)
    intents.receive(intent(80.0, (0.01, 0.0, 0.0, -0.02)), T0)
    request = intents.request(late_ns(robot, share))
    left = max(0.0, 1.0 - share)
    assert request.assist_n == pytest.approx(80.0 * left)
    assert request.shift == pytest.approx((0.01 * left, 0.0, 0.0, -0.02 * left))
    assert request.source == ""


def test_the_fade_is_slower_than_the_assist_may_fall(robot: RobotConfig) -> None:
    assert robot.assist.force_max / robot.assist.fade_s < robot.assist.rate_max


def test_an_intent_received_again_is_given_again(robot: RobotConfig) -> None:
    intents = Intents(robot.assist)
    intents.receive(intent(80.0), T0)
    intents.receive(intent(60.0), late_ns(robot, 0.9))
    assert intents.request(late_ns(robot, 0.95)).assist_n == 60.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_no_intent(robot: RobotConfig, bad: float) -> None:
    intents = Intents(robot.assist)
    intents.receive(intent(80.0), T0)
    intents.receive(intent(bad), T0 + 1)
    intents.receive(intent(1.0, (0.0, bad, 0.0, 0.0)), T0 + 2)
    assert intents.request(T0 + 3).assist_n == 80.0
