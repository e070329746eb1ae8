"""A battery that runs low in virtual time: told, then down, before the drives disarm."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from shared.bus.messages import Mode
from shared.bus.traces import SimTruth
from tests.lockstep.runs import modes_of, run, status_of, still
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep

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
