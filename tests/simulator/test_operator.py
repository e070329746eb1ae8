"""The simulated operator's hand: a clipped spring-damper at the harness point."""

from __future__ import annotations

import math

import pytest

from services.simulator.operator import Operator
from shared.config import RobotConfig
from shared.scenario import Lead

LEVEL = Lead(height=1.1, height_rate=0.0, pitch=0.0, pitch_rate=0.0, assist=0.0)


@pytest.fixture
def operator(robot: RobotConfig) -> Operator:
    return Operator(robot)


def harness_height(robot: RobotConfig, height: float, pitch: float) -> float:
    x, _, z = robot.geometry.harness_point
    return height - x * math.sin(pitch) + z * math.cos(pitch)


@pytest.mark.parametrize("pitch", [-0.2, 0.0, 0.6, 1.2])
def test_the_hand_rests_where_it_leads(
    robot: RobotConfig, operator: Operator, pitch: float
) -> None:
    wanted = LEVEL._replace(pitch=pitch)
    hand = operator.force(wanted, harness_height(robot, 1.1, pitch), 0.0, pitch, 0.0)
    assert hand == pytest.approx((0.0, 0.0), abs=1e-9)


def test_the_hand_moving_with_its_path_does_not_drag(
    robot: RobotConfig, operator: Operator
) -> None:
    """The harness point's own rate, from the path's height and pitch, by difference."""
    dt, pitch, rates = 1e-6, 0.7, (-0.2, 0.3)
    ahead = harness_height(robot, 1.1 + rates[0] * dt, pitch + rates[1] * dt)
    rate = (ahead - harness_height(robot, 1.1, pitch)) / dt
    wanted = Lead(height=1.1, height_rate=rates[0], pitch=pitch, pitch_rate=rates[1], assist=0.0)
    hand = operator.force(wanted, harness_height(robot, 1.1, pitch), rate, pitch, rates[1])
    assert hand == pytest.approx((0.0, 0.0), abs=1e-4)


def test_the_hand_is_a_spring_and_a_damper(robot: RobotConfig, operator: Operator) -> None:
    hand, at = robot.simulation.operator, 1.1 + robot.geometry.harness_point[2]
    assert operator.force(LEVEL, at - 0.02, 0.0, 0.0, 0.0).force_z == pytest.approx(0.02 * hand.k_z)
    assert operator.force(LEVEL, at, 0.1, 0.0, 0.0).force_z == pytest.approx(-0.1 * hand.b_z)
    turned = operator.force(LEVEL, at, 0.0, 0.1, 0.0)
    assert turned.moment_pitch == pytest.approx(-0.1 * hand.k_pitch)
    turning = operator.force(LEVEL, at, 0.0, 0.0, 0.1)
    assert turning.moment_pitch == pytest.approx(-0.1 * hand.b_pitch)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("far", [0.2, 10.0])
def test_the_hand_is_no_stronger_than_a_person(
    robot: RobotConfig, operator: Operator, sign: float, far: float
) -> None:
    hand = robot.simulation.operator
    got = operator.force(LEVEL, 1.1 - sign * far, 0.0, -2 * sign * far, 0.0)
    assert got == (sign * hand.force_max, sign * hand.moment_max)
