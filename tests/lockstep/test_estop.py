"""The emergency stop in virtual time: a slow sink, never a drop."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import Mode, SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Fault, Keyframe, Kill, Restart
from shared.joints import MODULES
from tests.lockstep.runs import at_rest, still
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep
from tools.sim.standing_start import begin_standing


@pytest.mark.sampled(3)
@pytest.mark.parametrize("height", [1.188, 0.9])
@pytest.mark.parametrize("hand", [True, False])
def test_the_robot_sinks_slowly_and_does_not_topple(
    robot: RobotConfig, height: float, hand: bool
) -> None:
    fleet = Lockstep(robot, still(12.0, height))
    begin_standing(fleet)
    rows: list[SimTruth] = []
    for truth in fleet.run():
        if truth.scenario_s >= 4.0 and not fleet.estop:
            fleet.estop = True
            if not hand:
                fleet.world.let_go()
        if fleet.estop:
            rows.append(truth)
            assert not truth.fallen, f"{truth.scenario_s:.2f} s"
            if at_rest(rows):
                break
    heights = [row.torso[2] for row in rows]
    assert all(controller.failsafe.mode is Mode.DAMP for controller in fleet.controllers)
    speed = -np.gradient(heights, 0.01)
    assert speed.max() < 0.25, "slowly"
    if not hand:  # a hand that holds on holds it up
        assert heights[-1] < heights[0] - 0.05, "it sinks"


def test_a_stop_without_a_planner_sinks_as_well(robot: RobotConfig) -> None:
    scenario = msgspec.structs.replace(still(10.0), hand=False)
    fleet = Lockstep(robot, scenario)
    fleet.planner = None
    heights = []
    for step in range(10_000):
        fleet.advance()
        fleet.estop = step > 3000
        if step % 10 == 0:
            truth = fleet.world.truth(0, 1.0, 0.0)
            heights.append(truth.torso[2])
            assert not truth.fallen, f"{step} ms"
    assert (-np.gradient(heights[300:], 0.01)).max() < 0.25


COM_BACK_AND_UP = {"body.com_offset": [-0.05, 0.0, 0.1]}
STOPPED: list[tuple[float, float, dict[str, Any]]] = [
    (1.188, 0.0, {}),
    (1.28, 0.0, {}),
    (1.295, 0.0, {"body.com_offset": [-0.02, 0.0, 0.03]}),
    (0.95, 0.0, {}),
    (0.9, 0.6, {}),
    (0.79, 1.2, {}),
    (1.188, 0.0, COM_BACK_AND_UP),
    (0.95, 0.0, COM_BACK_AND_UP | {"body.payload_scale": 1.2}),
    (0.79, 1.2, {"body.com_offset": [0.03, 0.0, -0.05], "body.payload_scale": 0.0}),
    (1.1, 0.3, {"body.payload_scale": 0.0, "drivetrain.stiffness": 3000.0}),
    (1.0, 0.0, {"drivetrain.stiffness": 2000.0, "drivetrain.play": 0.005}),
]


BEGUN_S = 3.8 + 5.0
"""The stop and its fade: from straight legs a light robot sinks by less than 1 mm until its end."""


class Stopped(NamedTuple):
    """What came of a stop."""

    fell: bool
    turned: float
    """Farthest that the torso's pitch went from where it was, rad."""
    sank: float
    """m"""
    speed: float
    """Fastest way down, m/s."""


def stop(
    robot: RobotConfig,
    height: float,
    pitch: float,
    plant: PlantConfig,
    kills: tuple[Kill, ...] = (),
    faults: tuple[Fault, ...] = (),
    restarts: tuple[Restart, ...] = (),
) -> Stopped:
    """Lead to a pose in 3 s, let go and stop at 3.8 s; go on until it rests, or for 10 s."""
    frames = (Keyframe(at=0.0, height=1.188), Keyframe(at=3.0, height=height, pitch=pitch))
    scenario = still(14.0, kill=kills, restart=restarts, fault=faults, push=())
    scenario = msgspec.structs.replace(scenario, keyframe=frames)
    law = msgspec.structs.replace(robot.law, load_correction=(0.0, 0.0))  # led whatever it carries
    fleet = Lockstep(msgspec.structs.replace(robot, law=law), scenario, plant=plant)
    begin_standing(fleet)
    happens_until_s = max((row.at for row in (*kills, *faults, *restarts)), default=0.0)
    rows: list[SimTruth] = []
    for truth in fleet.run():
        if truth.scenario_s >= 3.8 and not fleet.estop:
            fleet.estop = True
            fleet.world.let_go()
        if fleet.estop:
            rows.append(truth)
        rests = truth.scenario_s > max(happens_until_s + 1.5, BEGUN_S) and at_rest(rows)
        if truth.fallen or rests:
            break
    pitches, heights = ([row.angles[1] for row in rows], [row.torso[2] for row in rows])
    turned = np.abs(np.array(pitches) - pitches[0]).max()
    speed = -np.gradient(heights, 0.01)
    return Stopped(truth.fallen, turned, heights[0] - heights[-1], speed.max())


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("height", "pitch", "errors"), STOPPED)
def test_without_a_holder_the_torso_stays_as_it_stood(
    robot: RobotConfig, height: float, pitch: float, errors: dict[str, Any]
) -> None:
    """It turned back by 1.5 to 2.5 rad, and fell with the COM 5 cm back and 10 cm up."""
    found = stop(robot, height, pitch, changed(PlantConfig(), errors))
    assert not found.fell
    assert found.turned < 0.1
    assert found.speed < 0.25
    assert found.sank > 0.05 or height < 0.85, "it sinks"


@pytest.mark.sampled(3)
@pytest.mark.parametrize("number", range(4))
def test_so_it_does_on_drawn_plants(robot: RobotConfig, number: int) -> None:
    found = stop(robot, 0.9 + 0.07 * number, 0.3 * number, plants.draw(f"estop {number}"))
    assert not found.fell
    assert found.turned < 0.1
    assert found.speed < 0.25


@pytest.mark.parametrize("dead", ["planner", *MODULES[:3]])
def test_it_comes_down_on_its_feet_with_one_service_dead(robot: RobotConfig, dead: str) -> None:
    """A knee that sank beside one that its drive held tipped the robot sideways."""
    found = stop(robot, 1.0, 0.0, PlantConfig(), kills=(Kill(service=dead, at=3.6),))
    assert not found.fell
    assert found.turned < 0.1
    if dead.startswith("knee"):
        assert abs(found.sank) < 0.02, "it holds where it is"
    else:
        assert found.sank > 0.1


@pytest.mark.parametrize("limp", ["ankle_left", "hip_right"])
def test_it_does_not_fall_with_an_ankle_or_a_hip_limp(robot: RobotConfig, limp: str) -> None:
    fault = Fault(module=limp, kind="disarmed", at=3.7)
    found = stop(robot, 1.0, 0.0, PlantConfig(), faults=(fault,))
    assert not found.fell
    assert found.turned < 0.1


@pytest.mark.sampled(3)
@pytest.mark.parametrize("height", [0.9, 1.1])
@pytest.mark.parametrize("planner", ["alive", "dead"])
@pytest.mark.parametrize("at", [3.7, 5.0], ids=["before the stop", "after it"])
def test_beside_a_limp_knee_it_stops_sinking_and_stands(
    robot: RobotConfig, height: float, planner: str, at: float
) -> None:
    """Sinking on beside the limp knee all of 24 such stops fell, within 2 s."""
    kills = (Kill(service="planner", at=3.55),) if planner == "dead" else ()
    limp = (Fault(module="knee_left", kind="disarmed", at=at),)
    found = stop(robot, height, 0.0, PlantConfig(), kills=kills, faults=limp)
    assert not found.fell
    assert found.turned < 0.65, "0.55 measured at 1.1 m, with nobody holding on"
    assert found.sank < 0.15


@pytest.mark.parametrize("freezes_s", [0.05, 0.3])
def test_a_knee_that_pauses_on_the_way_down_tips_nothing(
    robot: RobotConfig, freezes_s: float
) -> None:
    """After a long pause both knees hold where they are; after a short one both sink."""
    pause = (Kill(service="knee_left", at=4.5, signal="STOP"),)
    goes_on = (Restart(service="knee_left", at=4.5 + freezes_s),)
    found = stop(robot, 1.0, 0.0, PlantConfig(), kills=pause, restarts=goes_on)
    assert not found.fell
    assert found.turned < 0.1
    assert (found.sank > 0.1) is (freezes_s < 0.1)


def test_a_knee_that_crashes_on_the_way_down_and_is_started_again_tips_nothing(
    robot: RobotConfig,
) -> None:
    crash = (Kill(service="knee_left", at=4.5),)
    again = (Restart(service="knee_left", at=5.2),)
    found = stop(robot, 1.0, 0.0, PlantConfig(), kills=crash, restarts=again)
    assert not found.fell
    assert found.turned < 0.1


@pytest.mark.parametrize("dead", ["ankle_left", "knee_right"])
def test_a_hip_whose_leg_falls_silent_on_the_way_down_goes_on_without_a_step(
    robot: RobotConfig, dead: str
) -> None:
    found = stop(
        robot,
        1.0,
        0.0,
        changed(PlantConfig(), COM_BACK_AND_UP),
        kills=(Kill(service=dead, at=6.0),),
    )
    assert not found.fell
    assert found.turned < 0.15


def test_a_stop_that_not_all_hear_tips_nothing(robot: RobotConfig) -> None:
    """One knee sank beside one that held."""
    fleet = Lockstep(robot, still(10.0, 1.0))
    begin_standing(fleet)
    for truth in fleet.run():
        if truth.scenario_s >= 4.0:
            fleet.world.let_go()
            for joint in fleet.joints:
                joint.manager._state.estop = joint.name != "knee_left"
        assert not truth.fallen
