"""The estimate of a module's heat, and how long its load can last."""

from __future__ import annotations

import math

import msgspec
import pytest

from services.joint.heat import LEFT_MAX_S, HeatEstimate
from shared.bus.messages import Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig

SQUAT: Pair = (20.2 * 0.0827, 14.9 * 0.0827)
"""Torques of a knee's motors, torso at 0.948 m; N m."""
LIGHT: Pair = (12.5 * 0.0827, 7.1 * 0.0827)
"""At 1.25 m."""


def with_heat(robot: RobotConfig, **changes: object) -> RobotConfig:
    """Return the robot with some keys of [heat] changed."""
    return msgspec.structs.replace(robot, heat=msgspec.structs.replace(robot.heat, **changes))


class Loaded:
    """An estimate under a load, by one cycle each 0.1 s."""

    def __init__(self, robot: RobotConfig, **changes: object) -> None:
        self.heat = HeatEstimate(with_heat(robot, **changes))
        self.now_s = 1.0

    def run(
        self, torque: Pair, seconds: float, fet: Pair | None = None, motor: Pair | None = None
    ) -> None:
        for k in range(round(10.0 * seconds)):
            once = k % 10 == 0
            self.heat.advance(
                round(self.now_s * NS_PER_S), torque, fet if once else None, motor if once else None
            )
            self.now_s += 0.1


@pytest.mark.parametrize("before_s", [30.0, 300.0])
def test_the_seconds_left_are_those_until_a_limit(robot: RobotConfig, before_s: float) -> None:
    loaded = Loaded(robot)
    loaded.run(SQUAT, before_s)
    left_s = loaded.heat.state.left_s
    assert 60.0 < left_s < 900.0
    loaded.run(SQUAT, left_s * 0.9)
    assert max(loaded.heat.state.winding) < robot.heat.winding_max
    loaded.run(SQUAT, left_s * 0.2)
    assert max(loaded.heat.state.winding) > robot.heat.winding_max
    assert loaded.heat.state.left_s == 0.0


def test_a_light_load_can_last(robot: RobotConfig) -> None:
    loaded = Loaded(robot)
    loaded.run(LIGHT, 20.0)
    assert loaded.heat.state.left_s == LEFT_MAX_S


def test_a_load_taken_off_leaves_more_time_within_seconds(robot: RobotConfig) -> None:
    loaded = Loaded(robot)
    loaded.run(SQUAT, 60.0)
    loaded.heat.skip(400.0)
    assert loaded.heat.state.left_s < 200.0
    loaded.run(LIGHT, 15.0)
    assert loaded.heat.state.left_s > 600.0


def test_no_seconds_left_are_negative_or_no_number_at_any_load_and_temperature(
    robot: RobotConfig,
) -> None:
    heat = HeatEstimate(robot)
    for winding in (-20.0, 40.0, 80.0, 99.99, 100.0, 250.0):
        for housing in (-20.0, 40.0, 95.0, 140.0):
            for amperes in (0.0, 1e-6, 5.0, 20.0, 40.0, 48.0, 400.0):
                state = heat.state
                state.winding = (winding, 40.0)
                state.housing = (housing, 40.0)
                state.load = ((amperes * 0.0827) ** 2, 0.0)
                left_s = heat._left_s(0)
                assert 0.0 <= left_s <= LEFT_MAX_S
                assert (left_s == 0.0) == (winding >= robot.heat.winding_max)


def test_what_the_drive_reports_counts_more_than_the_estimate(robot: RobotConfig) -> None:
    loaded = Loaded(robot, ambient=20.0)
    loaded.run(LIGHT, 60.0, fet=(85.0, 60.0), motor=(90.0, 88.0))
    assert loaded.heat.state.winding == pytest.approx((90.0, 88.0), abs=4.0)
    assert loaded.heat.state.stage[0] == pytest.approx(85.0, abs=1.0)
    silent = Loaded(robot, ambient=20.0)
    silent.run(LIGHT, 60.0)
    assert max(silent.heat.state.winding) < 40.0


def test_a_process_that_stood_still_takes_its_last_load_for_a_while_only(
    robot: RobotConfig,
) -> None:
    loaded = Loaded(robot)
    loaded.run(SQUAT, 10.0)
    before = loaded.heat.state.winding
    loaded.now_s += 3600.0
    loaded.run(SQUAT, 0.1)
    assert math.dist(before, loaded.heat.state.winding) < 6.0


def test_a_robot_file_without_heat_estimates_nothing(robot: RobotConfig) -> None:
    heat = HeatEstimate(with_heat(robot, estimate=False))
    assert not heat.enabled
    assert heat.state.left_s == -1.0
