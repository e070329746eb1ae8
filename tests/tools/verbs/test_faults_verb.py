"""`xrl faults`: the fault table, printed."""

from __future__ import annotations

import json

import pytest

from shared.places import DEFAULT_CONFIG
from shared.robot.fault_table import DRIVE_FAULTS, LOSSES
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS
from tools.verbs import faults


def test_every_row_is_printed_for_people_and_for_machines(
    capsys: pytest.CaptureFixture[str],
) -> None:
    trips = {trip.name for trip in (*JOINT_TRIPS, *PLANNER_TRIPS)}
    assert faults.run(faults.FaultsFlags(config=DEFAULT_CONFIG)) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in (*DRIVE_FAULTS, *LOSSES, *trips))
    assert "above 15 N m (trips.shaking)" in text
    assert "[robustness]" in text, "a key of the robot file is no colour"
    assert faults.run(faults.FaultsFlags(json=True, config=DEFAULT_CONFIG)) == 0
    table = json.loads(capsys.readouterr().out)
    assert set(table["drive"]) == set(DRIVE_FAULTS)
    assert set(table["fleet"]) == set(LOSSES)
    assert set(table["trips"]) == trips
