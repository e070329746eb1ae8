"""Where the feet stand, how the floor slopes, how it is asked to lean: it is led and stands."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import PlannerMode
from shared.config.scenarios import Inject
from tests.imu.robots import with_imu
from tests.lockstep.runs import (
    corner,
    kill,
    led_to,
    push,
    restart,
    run,
    status_of,
    variant,
)
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants
from tools.lab.studies.sweeps.figures import com_max_mm
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
    drawn: str, right: Foot, step: float
) -> None:
    pushes = (push(4.2, 30.0, 0.0, 0.0), push(5.2, 0.0, 30.0, 0.0))
    squat = led_to((2.0, 0.95), duration=6.5, kill=kill(3.8), push=pushes)
    outcome = run(ROBOT, squat, plant=with_foot(plants.draw(drawn), right, step), stands=False)
    assert outcome.stood
    assert outcome.com_mm[outcome.t < 3.7][-1, 2] < 800.0, "it was led down"
    assert outcome.tilt < 0.02
    assert outcome.believed


def test_a_planner_that_comes_back_leads_on_in_the_same_stance() -> None:
    plant = with_foot(PlantConfig(), (0.1, 0.0, 0.2))
    there = variant("stand", duration=3.8, kill=kill(0.3), restart=restart(0.6))
    outcome = run(ROBOT, there, plant=plant, stands=False)
    assert outcome.stood
    assert outcome.status.mode == PlannerMode.LEADING
    assert outcome.status.stance[0] == pytest.approx(0.1, abs=0.01)
    assert outcome.status.stance[5] == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize(
    ("right", "words"),
    [((0.2, 0.0, 0.0), "ahead of the left"), ((0.0, 0.0, -0.5), "turned outwards")],
)
def test_beyond_the_limit_it_only_holds(right: Foot, words: str) -> None:
    fleet = Lockstep(ROBOT, variant("stand", duration=2.0), plant=with_foot(PlantConfig(), right))
    rows = [row for row, _ in zip(fleet.run(), range(450), strict=False)]
    assert not any(row.fallen for row in rows)
    assert rows[-1].scenario_s < 0.0, "the person is not asked to lead it"
    assert rows[-1].hoist == 0.0
    status = status_of(fleet)
    assert (status.mode, status.hold) == (PlannerMode.MISPLACED, True)
    assert words in status.why


# ---- floors that slope, with a sensor that is half a degree wrong

DEG = math.radians(1.0)


def sloping(x_deg: float, y_deg: float) -> PlantConfig:
    slope, wrong = [x_deg * DEG, y_deg * DEG], [0.5 * DEG, -0.5 * DEG]
    return changed(PlantConfig(), {"floor.slope": slope, "imu.tilt": wrong})


@pytest.mark.sampled(3)
@pytest.mark.parametrize("slope", [(5.0, 0.0), (-5.0, 0.0), (0.0, 5.0), (-3.5, -3.5)])
def test_with_an_imu_it_squats_on_five_degrees_and_stands_without_a_planner(
    slope: tuple[float, float],
) -> None:
    pushes = (push(1.0, 30.0, 0.0, 0.0), push(2.5, 0.0, 30.0, 0.0), push(4.5, -25.0, -25.0, 0.0))
    scenario = variant("squat", duration=6.0, kill=kill(4.0), push=pushes)
    outcome = run(with_imu(ROBOT), scenario, plant=sloping(*slope))
    assert outcome.stood
    assert com_max_mm(outcome.rows) < 50.0
    assert np.abs(outcome.operator_n[outcome.t < 4.0]).max() < 30.0
    assert outcome.tilt < 0.03


def test_when_the_imu_falls_silent_the_last_slope_stands() -> None:
    cut = (Inject(link="imu->planner", at=0.5, partition=True),)
    happens = {"inject": cut, "push": (push(2.8, 0.0, 30.0, 0.0),)}
    scenario = led_to((0.5, 1.188), (2.5, 1.0, 0.4), duration=4.0, **happens)
    outcome = run(with_imu(ROBOT), scenario, plant=sloping(5.0, 0.0))
    assert outcome.stood
    assert com_max_mm(outcome.rows) < 30.0
    leaned = pytest.approx((5.0 * DEG, 0.0), abs=1.0 * DEG)
    assert outcome.status.slope == leaned, "not 23 degrees: it leans"


# ---- leans that are asked for

LEANING = {"kill": kill(3.0), "push": (push(3.3, 30.0, 0.0, 0.0), push(4.3, 0.0, 30.0, 0.0))}


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (-1, 1, -1, 1)])
def test_it_stands_in_the_farthest_corner(signs: tuple[int, ...]) -> None:
    x, y, roll, yaw = corner(ROBOT, signs)
    beyond = (x, y, 2.0 * roll, yaw)  # it comes to the limit
    outcome = run(ROBOT, led_to((2.0, 1.0, 0.0, 0.0, beyond), duration=5.6, **LEANING))
    there = int(np.searchsorted(outcome.t, 2.9))
    np.testing.assert_allclose(outcome.com_mm[there, :2], [1e3 * x, 1e3 * y], atol=6.0)
    assert outcome.angles[there, 0] == pytest.approx(roll, abs=0.01)
    assert outcome.angles[there, 2] == pytest.approx(yaw, abs=0.01)
    assert np.abs(outcome.operator_n[outcome.t < 2.9]).max() < 30.0, "the hand leads on"
    assert outcome.stood
    assert outcome.tilt < 0.05
    assert outcome.believed


def test_a_planner_that_comes_back_leads_to_the_same_lean() -> None:
    asked = (1.5, 1.1, 0.0, 0.0, (0.02, 0.03, 0.0, 0.08))
    outcome = run(ROBOT, led_to(asked, duration=6.5, kill=kill(2.0), restart=restart(2.4)))
    assert outcome.stood
    np.testing.assert_allclose(outcome.com_mm[-1, :2], [20.0, 30.0], atol=6.0)
    assert outcome.angles[-1, 2] == pytest.approx(0.08, abs=0.01)
    moved = np.abs(np.diff(outcome.com_mm[:, :2], axis=0)).max()
    assert moved < 2.0, "it goes there, it does not jump"


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("drawn", "signs"), [("shift-15", (-1, -1, 1, -1)), ("shift-21", (-1, 1, -1, 1))]
)
def test_it_stands_at_the_corner_on_plants_with_every_error_drawn(
    drawn: str, signs: tuple[int, ...]
) -> None:
    """The two of 36 that went farthest: 69 and 73 mm."""
    pose = (2.0, 1.188, 0.0, 0.0, corner(ROBOT, signs))
    pushes = (push(4.2, 30.0, 0.0, 0.0), push(5.2, -30.0, 0.0, 0.0))
    leaned = led_to(pose, duration=6.5, kill=kill(3.8), push=pushes)
    outcome = run(ROBOT, leaned, plant=plants.draw(drawn))
    assert outcome.stood
    assert np.hypot(*outcome.com_mm[-1, :2]) > 20.0, "it leans to the end"
    assert outcome.believed
