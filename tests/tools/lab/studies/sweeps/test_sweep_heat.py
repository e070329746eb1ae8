"""The heat study: how long poses last, and its trials."""

from __future__ import annotations

import msgspec
import pytest

from shared.bus.messages import LEFT_MAX_S
from shared.config.robot_config import RobotConfig
from tools.lab.studies.sweeps import heat, heat_trial


def on_a_day(robot: RobotConfig, ambient: float) -> RobotConfig:
    return msgspec.structs.replace(robot, heat=msgspec.structs.replace(robot.heat, ambient=ambient))


def test_a_pose_is_held_longer_where_it_is_cool_straight_or_folded_and_without_assist(
    robot: RobotConfig,
) -> None:
    cool, hot = on_a_day(robot, 20.0), on_a_day(robot, 45.0)
    squat = heat.held(hot, 0.948, 0.0, 0.0)
    assert squat.module.startswith("knee")
    assert 300.0 < squat.seconds < heat.held(cool, 0.948, 0.0, 0.0).seconds
    assert heat.held(hot, 0.948, 0.0, 200.0).seconds < 0.3 * squat.seconds
    assert heat.held(hot, 1.25, 0.0, 0.0).seconds == LEFT_MAX_S
    assert heat.held(hot, 0.79, 0.0, 0.0).seconds > 2.0 * squat.seconds


def test_every_person_comes_on_a_plant_and_to_a_pose_of_their_own(robot: RobotConfig) -> None:
    trials = [heat_trial.draw(1, number) for number in range(12)]
    assert {trial.person for trial in trials} == set(heat_trial.PEOPLE)
    plant = heat_trial.plant_of(trials[0])
    assert plant.heat.ambient == pytest.approx(trials[0].ambient)
    assert plant.heat.winding_capacity != robot.heat.winding_capacity
    assert heat_trial.scenario_of(robot, trials[0]).keyframe[-1].height == trials[0].height
