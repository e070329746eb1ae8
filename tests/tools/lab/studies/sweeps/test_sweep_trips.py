"""The study of the trips: each comes where it is to, none where not, and it says which did not."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from shared.bus.messages import Cause, Trip
from shared.config.robot_config import RobotConfig
from shared.places import DEFAULT_CONFIG
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS
from tools import cli
from tools.lab.studies.sweeps.trips import wrong_with
from tools.lab.studies.sweeps.trips_trial import (
    BEGINS_S,
    PLANTS,
    TROUBLES,
    TripResult,
    TripRun,
    TripTrial,
    run_trial,
)

HARD_PLANT = "small errors"


def row(trouble: str, **changes: object) -> dict[str, object]:
    begin: dict[str, object] = {"number": 0, "trouble": trouble, "on": "k 2000"}
    figures = dict.fromkeys(TripResult.__struct_fields__)
    return begin | figures | {"led": True, "tripped": ""} | changes


TRIPS = [name for name, trouble in TROUBLES.items() if isinstance(trouble.trip, Trip)]
"""Without the gains that shake: these are in `tests/lockstep/test_trips.py`, on every plant."""


@pytest.mark.parametrize("trouble", TRIPS)
def test_on_a_plant_of_many_errors_what_is_to_trip_trips_and_stands(
    trouble: str, robot: RobotConfig
) -> None:
    outcome = run_trial(TripTrial(number=0, trouble=trouble, on=HARD_PLANT), robot, seed=1)
    assert wrong_with(row(trouble) | msgspec.structs.asdict(outcome)) == ""
    assert outcome.tripped_after_s is not None
    assert outcome.tripped_after_s > 0.0
    # a height that nobody leads is closed, without trips too
    assert outcome.speed_max < max(outcome.untripped_speed_max, 0.25)


@pytest.mark.parametrize(
    "trouble", [name for name, trouble in TROUBLES.items() if trouble.trip is None]
)
def test_on_a_plant_of_many_errors_nothing_trips_for_nothing_and_it_stands(
    trouble: str, robot: RobotConfig
) -> None:
    seen = TripRun(robot, TROUBLES[trouble], PLANTS[HARD_PLANT], seed=1)
    assert seen.fleet.world.scenario_s > BEGINS_S
    assert (seen.trips, seen.fell_at_s) == ({}, None)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (row("squats"), ""),
        (row("squats", tripped="LEGS"), "tripped for nothing: LEGS"),
        (row("squats", fell_at_s=2.5), "fell at 2.5 s"),
        (row("sags", tripped="SAGGING"), ""),
        (row("sags", tripped="SINKING"), ""),
        (row("sags"), "SAGGING never tripped"),
        (row("sags", tripped="SAGGING", fell_at_s=3), "fell at 3 s"),
        (row("shakes", tripped="SHAKING", untripped_fell_at_s=1), ""),
        (row("shakes"), ""),
        (row("shakes", led=False, tripped="SHAKING", untripped_fell_at_s=1), ""),
        (row("squats", led=False), "the robot was never led so far that anything could happen"),
        (row("sags", led=False), "the robot was never led so far that anything could happen"),
        (row("shakes", untripped_fell_at_s=1), "SHAKING never tripped"),
    ],
)
def test_it_names_what_is_wrong_with_a_row(given: dict[str, object], words: str) -> None:
    assert wrong_with(given) == words


@pytest.mark.parametrize(("text", "whole"), [("SAGGING LEGS", True), ("", True), ("SAGG", False)])
def test_a_row_that_names_no_trip_is_damaged(text: str, whole: bool) -> None:
    given = dict.fromkeys(TripResult.__struct_fields__, "1") | {"tripped": text}
    try:
        msgspec.convert(given, TripResult, strict=False)
    except msgspec.ValidationError:
        assert not whole
    else:
        assert whole


def test_what_is_to_trip_is_in_the_table_of_trips() -> None:
    known: set[Trip | Cause | None] = {None, *JOINT_TRIPS, *PLANNER_TRIPS}
    assert {trouble.trip for trouble in TROUBLES.values()} <= known
    assert {trouble.trip for trouble in TROUBLES.values()} >= {None, Cause.SHAKING, Trip.SAGGING}
    assert set(PLANTS) >= {"rigid", "k 2000", HARD_PLANT}


def test_a_robot_on_which_nothing_trips_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = DEFAULT_CONFIG.read_text(encoding="utf-8")
    assert 'split = "certified"' in shipped
    diagonal = tmp_path / "robot.toml"
    diagonal.write_text(shipped.replace('split = "certified"', 'split = "diagonal"'), "utf-8")
    assert cli.main(["study", "trips", "--config", str(diagonal)]) == 2
    assert "only robots of the certified split have trips" in capsys.readouterr().err
