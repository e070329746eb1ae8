"""Heat and supply at their end: the robot stands up, or goes down, by itself and in time."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from shared.bus.messages import HeatAction, Mode, PlannerMode
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
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
                fleet.skip_heat(1.0)
        actions.append(status_of(fleet).heat)
        derating = min(derating, fleet.bank.heat.derating)
    return Held(fleet, rows, actions, derating)


@pytest.mark.parametrize("hand", [True, False], ids=["a hand that clings", "nobody's hand"])
def test_a_robot_too_hot_for_its_squat_stands_up_by_itself_and_derates_nowhere(hand: bool) -> None:
    held = hold(ROBOT, standing_as(ROBOT), hand=hand)
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


def test_without_an_estimate_nothing_is_said_and_nothing_done() -> None:
    heat = msgspec.structs.replace(ROBOT.heat, estimate=False)
    deaf = msgspec.structs.replace(ROBOT, heat=heat)
    held = hold(deaf, standing_as(deaf), skip=False, until_s=1.0)
    assert set(held.actions) == {HeatAction.NONE}
    assert status_of(held.fleet).heat_left_s == -1.0


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
