"""Feet ahead, apart, turned and on a step: led as they stand; beyond the limits only held."""

from __future__ import annotations

import msgspec
import pytest

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import PlannerMode
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe
from tests.lockstep.runs import kill, push, restart, run, variant
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep

Foot = tuple[float, float, float]


def with_foot(plant: PlantConfig, right: Foot, step: float = 0.0) -> PlantConfig:
    """Return a plant with the right foot moved and turned, and the floor under it raised."""
    feet = msgspec.structs.replace(plant.feet, offset_right=right, offset_left=(0.0, 0.0, 0.0))
    floor = msgspec.structs.replace(plant.floor, step=step)
    return msgspec.structs.replace(plant, feet=feet, floor=floor)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("drawn", "right", "step"),
    [
        ("stance-1", (-0.1, 0.12, 0.3), -0.02),
        ("stance-10", (-0.1, -0.12, -0.3), 0.02),
        ("stance-27", (0.1, -0.12, -0.3), -0.02),
        ("stance-55", (0.1, 0.12, 0.15), 0.0),
    ],
)
def test_every_error_drawn_it_squats_in_its_stance_and_stands_pushed_without_a_planner(
    robot: RobotConfig, drawn: str, right: Foot, step: float
) -> None:
    frames = (Keyframe(at=0.0, height=1.188), Keyframe(at=2.0, height=0.95))
    pushes = (push(4.2, 30.0, 0.0, 0.0), push(5.2, 0.0, 30.0, 0.0))
    squat = variant("stand", duration=6.5, keyframe=frames, kill=kill(3.8), push=pushes)
    outcome = run(robot, squat, plant=with_foot(plants.draw(drawn), right, step), stands=False)
    assert outcome.stood
    assert outcome.com_mm[outcome.t < 3.7][-1, 2] < 800.0, "it was led down"
    assert max(max(row.foot_left_tilt, row.foot_right_tilt) for row in outcome.rows) < 0.02


def test_a_planner_that_comes_back_leads_on_in_the_same_stance(robot: RobotConfig) -> None:
    plant = with_foot(PlantConfig(), (0.1, 0.0, 0.2))
    there = variant("stand", duration=6.0, kill=kill(2.0), restart=restart(2.5), push=())
    outcome = run(robot, there, plant=plant, stands=False)
    assert outcome.stood
    planner = outcome.lockstep.planner
    assert planner is not None
    status = planner.status(0, 0.0)
    assert status.mode == PlannerMode.LEADING
    assert status.stance[0] == pytest.approx(0.1, abs=0.01)
    assert status.stance[5] == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize(
    ("right", "words"),
    [((0.2, 0.0, 0.0), "ahead of the left"), ((0.0, 0.0, -0.5), "turned outwards")],
)
def test_beyond_the_limit_it_is_not_led_and_stands_in_hold(
    robot: RobotConfig, right: Foot, words: str
) -> None:
    plant = with_foot(PlantConfig(), right)
    fleet = Lockstep(robot, variant("stand", duration=2.0), Impairment(delay_ms=1.0), plant=plant)
    row = None
    for row, _ in zip(fleet.run(), range(600), strict=False):
        assert not row.fallen
        assert row.scenario_s < 0.0, "the person is not asked to lead it"
    assert row is not None
    assert row.hoist == 0.0
    assert fleet.planner is not None
    status = fleet.planner.status(0, 0.0)
    assert status.mode == PlannerMode.MISPLACED
    assert status.hold
    assert words in status.why
