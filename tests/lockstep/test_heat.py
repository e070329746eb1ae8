"""Heat and supply at their end: the robot stands up, or goes down, by itself and in time."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from services.joint.differential import motor_torque
from services.joint.heat import HeatEstimate, report
from services.planner.law.kinematics import Kinematics
from shared.bus.messages import LEFT_MAX_S, HeatAction, Mode, PlannerMode
from shared.bus.traces import SimTruth
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.robot.robot_model import stand_pose
from tests.lockstep.runs import led_to, modes_of, run, standing_as, status_of, still
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import FleetMoment, Lockstep

HELD_S = 5.5
SQUAT = 0.948


class Held(NamedTuple):
    """What was seen of a held squat."""

    fleet: Lockstep
    rows: list[SimTruth]
    actions: list[int]
    derating: float


def hold(
    robot: RobotConfig, start: FleetMoment, *, hand: bool = True, until_s: float = 16.0,
    skip: bool = True,
) -> Held:  # fmt: skip
    """Squat, let the time pass for the temperatures until 33 s are left, and run on."""
    fleet = Lockstep(robot, led_to((2.0, SQUAT), duration=until_s))
    fleet.resume(start)
    rows, actions, derating, skips = [], [], 1.0, skip
    for row in fleet.run():
        rows.append(row)
        if not hand and row.scenario_s > 0.5 * HELD_S:
            fleet.world.let_go()
        if skips and row.scenario_s > HELD_S:
            skips = False
            while min(law.heat.left_s for law in fleet.controllers) > 33.0:
                fleet.bank.heat.skip(fleet.bank.heat.load, 1.0)
                for joint, law in zip(fleet.joints, fleet.controllers, strict=True):
                    joint.manager.controller.heat.skip(law.heat, 1.0)
                    report(law.heat, *joint.drive.thermistors())
        actions.append(status_of(fleet).heat)
        derating = min(derating, fleet.bank.heat.derating)
    return Held(fleet, rows, actions, derating)


@pytest.mark.parametrize("hand", [True, False], ids=["a hand that clings", "nobody's hand"])
def test_a_robot_too_hot_for_its_squat_stands_up_by_itself_and_derates_nowhere(
    robot: RobotConfig, hand: bool
) -> None:
    held = hold(robot, standing_as(robot), hand=hand)
    assert list(dict.fromkeys(held.actions)) == [
        HeatAction.NONE, HeatAction.EASES, HeatAction.STANDS_UP, HeatAction.RESTS,
    ]  # fmt: skip
    last = held.rows[-1]
    assert not last.fallen
    assert last.torso[2] > 1.2
    assert held.derating == 1.0
    status = status_of(held.fleet)
    assert status.mode == PlannerMode.LEADING
    assert status.heat_left_s > 60.0
    assert max(abs(1e3 * row.com[0]) for row in held.rows) < 15.0
    assert max(law.heat.winding[0] for law in held.fleet.controllers) < 100.0


def test_without_an_estimate_nothing_is_said_and_nothing_done(robot: RobotConfig) -> None:
    heat = msgspec.structs.replace(robot.heat, estimate=False)
    deaf = msgspec.structs.replace(robot, heat=heat)
    held = hold(deaf, standing_as(deaf), skip=False, until_s=1.0)
    assert set(held.actions) == {HeatAction.NONE}
    assert status_of(held.fleet).heat_left_s == -1.0


@pytest.mark.parametrize(
    ("height", "assist_n", "minutes"),
    [
        (0.948, 0.0, {20.0: 19.2, 45.0: 6.2}),
        (0.948, 200.0, {20.0: 2.8, 45.0: 1.0}),
        (1.07, 0.0, {20.0: 18.8, 45.0: 6.0}),
        (1.25, 0.0, {20.0: LEFT_MAX_S / 60.0, 45.0: LEFT_MAX_S / 60.0}),
    ],
)
def test_a_pose_can_be_held_as_long_as_the_results_say(
    robot: RobotConfig, height: float, assist_n: float, minutes: dict[float, float]
) -> None:
    """docs/results.md#held-poses, from motors as warm as the air."""
    kinematics = Kinematics(robot)
    kinematics.update(np.array(stand_pose(robot, height)))
    weight_n = robot.total_mass * GRAVITY
    tau = weight_n * kinematics.J[2] + assist_n * kinematics.J_harness[2]
    for ambient, expected in minutes.items():
        heat = msgspec.structs.replace(robot.heat, ambient=ambient)
        day = msgspec.structs.replace(robot, heat=heat)
        left = []
        for phi, theta in tau.reshape(-1, 2).tolist():
            estimate = HeatEstimate(day)
            a, b = motor_torque((phi, theta), robot.joint.gear_ratio)
            state = estimate.cold()
            state.load = (a * a, b * b)
            estimate.skip(state, 0.0)
            left.append(state.left_s)
        assert min(left) / 60.0 == pytest.approx(expected, rel=0.02, abs=0.06)


# ---- a battery that runs low: told, then down, before the drives disarm

FALL_V_S = 0.4
"""How fast the supplies fall: far faster than a battery's end."""
BEGINS_V, UNDERVOLTAGE_V = 45.0, 38.0


@pytest.mark.sampled(8)
@pytest.mark.parametrize("number", range(8))
def test_it_is_told_and_the_robot_is_down_before_the_drives_disarm(number: int) -> None:
    told: dict[str, float] = {}

    def empties(fleet: Lockstep, row: SimTruth) -> bool:
        bus = fleet.bank.bus
        fleet.bank.settings.fill("config.dc_bus_undervoltage_trip_level", UNDERVOLTAGE_V)
        bus.supply = np.minimum(bus.supply, BEGINS_V) - 0.01 * FALL_V_S
        bus.changed()
        why = status_of(fleet).why
        if "change the battery" in why:
            told.setdefault("low", row.scenario_s)
        if "put a stand" in why:
            told.setdefault("sits", row.scenario_s)
        if row.torso[2] < 0.86:
            told.setdefault("down", row.scenario_s)
        return {*modes_of(fleet)} != {Mode.TRACK} and "down" in told

    scenario = msgspec.structs.replace(still(40.0), hand=False)
    plant = plants.draw(f"battery {number}")
    outcome = run(ROBOT, scenario, plant=plant, each=empties)
    disarmed = outcome.rows[-1].scenario_s
    assert told["low"] < told["sits"] - 2.0
    assert told["down"] < disarmed - 2.0
    assert outcome.rows[-1].torso[2] < 0.86
    assert not outcome.rows[-1].fallen
