"""A robot that falls notices it and lets go; one that is shoved, led or hoisted does not."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Final, NamedTuple

import pytest

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import Cause, Mode
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.places import DEFAULT_CONFIG
from tests.lockstep.runs import modes_of, status_of
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants, robust
from tools.lab.studies.sweeps.plants import PushRange
from tools.live.experiment import load_robot
from tools.sim.lockstep import Lockstep

WITH_IMU: Final = load_robot(DEFAULT_CONFIG, imu=True)
STAND: Final = ROBOT.simulation.stand_height
FOUND_S: Final = 0.3
AFTER_S: Final = 1.5
"""Watched for so long after a fall."""
Nudge = Callable[[Lockstep, SimTruth], None]


class Watched(NamedTuple):
    """What came of a run."""

    fleet: Lockstep
    late_s: float | None
    """From the moment at which the simulator calls it fallen to the planner's; None: it stood."""
    found: bool


def watched(
    robot: RobotConfig,
    scenario: Scenario,
    plant: PlantConfig,
    nudge: Nudge = lambda _fleet, _row: None,
) -> Watched:
    """Run a scenario to its end, or for a while beyond a fall."""
    fleet = Lockstep(robot, scenario, plant=plant)
    fell_ns = 0
    for row in fleet.run():
        nudge(fleet, row)
        fell_ns = fell_ns or (row.t_ns if row.fallen else 0)
        since_s = (row.t_ns - fell_ns) / NS_PER_S if fell_ns else 0.0
        if since_s > AFTER_S:
            break
    assert fleet.planner is not None
    found_ns = fleet.planner.state.fall.fell_ns
    late_s = (found_ns - fell_ns) / NS_PER_S if fell_ns and found_ns else None
    return Watched(fleet, math.inf if fell_ns and not found_ns else late_s, found_ns > 0)


def shove(number: int) -> tuple[Scenario, PlantConfig]:
    """Return a drawn robot that is shoved over, in the stand, a squat or on the way to a crawl."""
    dice = random.Random(f"fall {number}")
    ways = (
        (Keyframe(2.0, 0.948), Keyframe(4.0, STAND)), (Keyframe(4.0, 0.79, pitch=1.2),), (), (),
    )  # fmt: skip
    angle, force = dice.uniform(-math.pi, math.pi), dice.uniform(180.0, 400.0)
    at, lasts = dice.uniform(0.5, 4.0), dice.uniform(0.3, 0.8)
    push = Push(at, lasts, (force * math.cos(angle), force * math.sin(angle), 0.0))
    scenario = Scenario(
        name="shoved over", about="by a hard push", duration=at + 4.0,
        keyframe=(Keyframe(0.0, STAND), *ways[number % len(ways)]), push=(push,),
        hand=dice.random() < 0.7,
    )  # fmt: skip
    return scenario, plants.draw(f"fall {number}")


@pytest.mark.sampled(50)
@pytest.mark.parametrize("number", range(100))
def test_with_an_imu_every_fall_is_found_within_0_3_s_and_all_let_go(number: int) -> None:
    """Before, a module pressed on the floor with 116 N m, and some robots led again as they lay."""
    run = watched(WITH_IMU, *shove(number))
    assert run.late_s is not None
    assert run.late_s <= FOUND_S
    gone = {Mode.DAMP, Mode.FAULT}
    assert set(modes_of(run.fleet)) <= gone
    assert {each.cause for each in run.fleet.controllers if each.failsafe.mode is Mode.DAMP} == {
        Cause.FALLEN
    }
    status = status_of(run.fleet)
    assert "the robot has fallen" in status.why
    assert "xrl rearm" in status.why


def lifted(number: int) -> tuple[Scenario, PlantConfig, Nudge]:
    """Return a drawn robot that a hoist lifts off its feet, aside and not gently, and then swings.

    It swings as on a rope of 2 to 4 m.
    """
    dice = random.Random(f"hoist {number}")
    at, speed = dice.uniform(1.0, 3.0), dice.uniform(0.1, 0.5)
    aside = [dice.uniform(-0.15, 0.15), dice.uniform(-0.15, 0.15)]
    swing, omega = dice.uniform(0.0, 0.25), dice.uniform(1.5, 2.2)
    start: list[float] = []

    def nudge(fleet: Lockstep, row: SimTruth) -> None:
        since_s = row.scenario_s - at
        if since_s < 0.0:
            return
        start[:] = start or row.torso
        hoist = fleet.world.outside.hoist
        away = swing * min(1.0, max(0.0, since_s - 2.0)) * math.sin(omega * since_s)
        held = 0.01 if since_s < 2.0 else 1.0
        for axis in (0, 1):
            there = start[axis] + aside[axis] + (away if axis == number % 2 else 0.0)
            hoist.position[axis] = row.torso[axis] + held * (there - row.torso[axis])
        hoist.position[2] = start[2] + min(0.3, speed * since_s)
        hoist.share, hoist.releasing = min(1.0, 2.0 * since_s), False

    scenario = Scenario(
        name="lifted", about="off its feet", duration=8.0, hand=dice.random() < 0.5,
        keyframe=(Keyframe(0.0, STAND), Keyframe(1.0, dice.choice((STAND, 1.0, 0.9)))),
    )  # fmt: skip
    return scenario, plants.draw(f"hoist {number}"), nudge


@pytest.mark.sampled(100)
@pytest.mark.parametrize("number", range(100))
def test_a_robot_on_a_hoist_that_swings_has_not_fallen(number: int) -> None:
    scenario, plant, nudge = lifted(number)
    assert not watched(WITH_IMU, scenario, plant, nudge).found


@pytest.mark.sampled(100)
@pytest.mark.parametrize("number", range(200))
def test_led_leaned_on_shoved_and_killed_what_stands_has_not_fallen(number: int) -> None:
    """Every third one on a slope of up to ten degrees, on which it may not even be led."""
    slope_deg = 0.05 * number if number % 3 == 0 else 0.0
    trial = robust.draw(PushRange(ROBOT), 57, number, slope_deg=slope_deg)
    run = watched(WITH_IMU, trial.scenario(ROBOT), trial.true_plant())
    assert run.late_s is not None or not run.found


def test_a_robot_that_lies_presses_on_nothing_and_is_not_led_when_it_is_rearmed() -> None:
    scenario, plant = shove(4)
    fleet = Lockstep(WITH_IMU, scenario, plant=plant)
    rows = fleet.run()
    fell_s = next(row.scenario_s for row in rows if row.fallen)
    next(row for row in rows if row.scenario_s > fell_s + AFTER_S)
    assert set(modes_of(fleet)) == {Mode.DAMP}
    assert max(abs(tau) for each in fleet.controllers for tau in each.tau) < 30.0
    for joint in fleet.joints:
        joint.kill(for_good=True)
        joint.restart()
    seen = set()
    for row in rows:
        seen |= set(modes_of(fleet))
        if row.scenario_s > fell_s + AFTER_S + 2.0:
            break
    assert Mode.HOLD in seen
    assert Mode.TRACK not in seen
    assert status_of(fleet).hold
