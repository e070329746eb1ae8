"""The study of the trips: each comes where it is to, none where not, and it says which did not."""

from __future__ import annotations

import csv
from pathlib import Path

import msgspec
import pytest

from shared.bus.messages import Cause, Trip
from shared.config.robot_config import RobotConfig
from shared.places import DEFAULT_CONFIG
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS
from tools import cli
from tools.lab.studies.sweeps.trips import exit_code, wrong_with
from tools.lab.studies.sweeps.trips_trial import PLANTS, TROUBLES, TripResult, run_trial

HARD_PLANT = "small errors"


def row(trouble: str, **changes: str) -> dict[str, str]:
    begin = {"number": "0", "trouble": trouble, "on": "k 2000"}
    return begin | dict.fromkeys(TripResult.__struct_fields__, "") | {"led": "True"} | changes


@pytest.mark.parametrize("trouble", [name for name in TROUBLES if not TROUBLES[name].unfiltered])
def test_on_a_plant_of_many_errors_what_is_to_trip_trips_and_stands(
    trouble: str, robot: RobotConfig
) -> None:
    """The gains that shake are in `tests/lockstep/test_trips.py`, on every plant."""
    outcome = run_trial(trouble, HARD_PLANT, robot, seed=1)
    text = {
        name: "" if value is None else str(value)
        for name, value in msgspec.structs.asdict(outcome).items()
    }
    assert wrong_with(row(trouble) | text) == ""
    if TROUBLES[trouble].trip is not None:
        assert outcome.tripped_after_s is not None
        assert outcome.tripped_after_s > 0.0
        assert outcome.speed_max < outcome.untripped_speed_max


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (row("squats"), ""),
        (row("squats", tripped="LEGS"), "tripped for nothing: LEGS"),
        (row("squats", fell_at_s="2.5"), "fell at 2.5 s"),
        (row("sags", tripped="SAGGING"), ""),
        (row("sags", tripped="SINKING"), ""),
        (row("sags"), "SAGGING never tripped"),
        (row("sags", tripped="SAGGING", fell_at_s="3"), "fell at 3 s"),
        (row("shakes", tripped="SHAKING", untripped_fell_at_s="1"), ""),
        (row("shakes"), ""),
        (row("shakes", led="False", tripped="SHAKING", untripped_fell_at_s="1"), ""),
        (row("squats", led="False"), "the robot was never led so far that anything could happen"),
        (row("sags", led="False"), "the robot was never led so far that anything could happen"),
        (row("shakes", untripped_fell_at_s="1"), "SHAKING never tripped"),
    ],
)
def test_it_names_what_is_wrong_with_a_row(given: dict[str, str], words: str) -> None:
    assert wrong_with(given) == words


@pytest.mark.parametrize(
    ("changes", "code"),
    [({"tripped": "SAGGING"}, 0), ({}, 3), ({"tripped": "SAGGING", "fell_at_s": "2.1"}, 1)],
    ids=["tripped", "never tripped", "fell"],
)
def test_a_trip_that_did_not_come_is_a_fault_and_one_that_did_not_save_a_fall(
    changes: dict[str, str], code: int
) -> None:
    assert exit_code([row("sags", tripped="SAGGING"), row("sags", **changes)]) == code


def test_what_is_to_trip_is_in_the_table_of_trips() -> None:
    known: set[Trip | Cause | None] = {None, *JOINT_TRIPS, *PLANNER_TRIPS}
    assert {trouble.trip for trouble in TROUBLES.values()} <= known
    assert {trouble.trip for trouble in TROUBLES.values()} >= {None, Cause.SHAKING, Trip.SAGGING}
    assert set(PLANTS) >= {"rigid", "k 2000", HARD_PLANT}


def test_the_study_prints_its_matrix_and_goes_on_with_what_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = [
        "study",
        "sweep",
        "trips",
        "--trouble",
        "drops",
        "--on",
        "rigid",
        "--out",
        str(tmp_path),
    ]
    assert cli.main([*asked, "--workers", "1"]) == 0
    first = capsys.readouterr().out
    assert "sagging" in first
    assert "led down by 0.39 m in 0.3 s" in first
    (only,) = csv.DictReader((tmp_path / "trips.csv").open(encoding="utf-8"))
    assert only["tripped"] == "SAGGING"
    assert cli.main(asked) == 0
    assert "1 of 1 cases are done already" in capsys.readouterr().out


def test_a_robot_on_which_nothing_trips_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = DEFAULT_CONFIG.read_text(encoding="utf-8")
    assert 'split = "certified"' in shipped
    diagonal = tmp_path / "robot.toml"
    diagonal.write_text(shipped.replace('split = "certified"', 'split = "diagonal"'), "utf-8")
    assert cli.main(["study", "sweep", "trips", "--config", str(diagonal)]) == 2
    assert "only robots of the certified split have trips" in capsys.readouterr().err
