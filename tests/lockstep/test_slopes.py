"""Floors that slope, on the realistic plant with a sensor that is half a degree wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.physics.plant import PlantConfig, changed
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Keyframe, Kill
from tests.imu.robots import with_imu
from tests.lockstep.runs import Run, push, run, variant

DEG = math.radians(1.0)
WRONG = [0.5 * DEG, -0.5 * DEG]


def sloping(x_deg: float, y_deg: float) -> PlantConfig:
    slope = [x_deg * DEG, y_deg * DEG]
    return changed(PlantConfig(), {"floor.slope": slope, "imu.tilt": WRONG})


def over_mm(outcome: Run) -> float:
    """Return how far from over the ankles the COM was by gravity, at most."""
    return 1e3 * max(math.hypot(*row.over) for row in outcome.rows)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("slope", [(5.0, 0.0), (-5.0, 0.0), (0.0, 5.0), (-3.5, -3.5)])
def test_with_an_imu_it_squats_on_five_degrees_is_pushed_and_stands_when_the_planner_dies(
    robot: RobotConfig, slope: tuple[float, float]
) -> None:
    scenario = variant(
        "squat",
        duration=6.0,
        kill=(Kill(service="planner", at=4.0),),
        push=(push(1.0, 30.0, 0.0, 0.0), push(2.5, 0.0, 30.0, 0.0), push(4.5, -25.0, -25.0, 0.0)),
    )
    outcome = run(with_imu(robot), scenario, plant=sloping(*slope))
    assert outcome.stood
    assert over_mm(outcome) < 50.0
    assert np.abs(outcome.operator_n[outcome.t < 4.0]).max() < 30.0
    assert max(max(row.foot_left_tilt, row.foot_right_tilt) for row in outcome.rows) < 0.03


def test_when_the_imu_falls_silent_the_last_slope_stands(robot: RobotConfig) -> None:
    cut = (Inject(link="imu->planner", at=0.5, partition=True),)
    leans = (Keyframe(at=0.5, height=1.188), Keyframe(at=2.5, height=1.0, pitch=0.4))
    pushed = (push(2.8, 0.0, 30.0, 0.0),)
    scenario = variant("stand", duration=4.0, keyframe=leans, inject=cut, push=pushed)
    outcome = run(with_imu(robot), scenario, plant=sloping(5.0, 0.0))
    assert outcome.stood
    assert over_mm(outcome) < 30.0
    assert outcome.lockstep.planner is not None
    slope = outcome.lockstep.planner.status(outcome.lockstep.now_ns, 0.0).slope
    assert slope == pytest.approx((5.0 * DEG, 0.0), abs=1.0 * DEG), "not 23 degrees: it leans"


def test_on_a_level_floor_an_imu_changes_little_that_the_hand_feels(robot: RobotConfig) -> None:
    scenario = variant("squat", duration=4.0, kill=(), push=())
    outcome = run(with_imu(robot), scenario, plant=sloping(0.0, 0.0))
    assert outcome.stood
    assert np.abs(outcome.operator_n).max() < 26.0, "23 N measured, 19 without an IMU"
    assert over_mm(outcome) < 20.0
