"""What flags make of a scenario: the drives' faults."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import pytest

from shared.config.gain_schedule import path_beside
from shared.config.scenarios import FAULT_KINDS, Fault
from shared.exceptions import ConfigError, FleetError
from shared.places import DEFAULT_CONFIG, SCENARIOS
from tools.flags import add_flags, read_flags
from tools.live import experiment


def parse(*arguments: str) -> experiment.ExperimentFlags:
    parser = argparse.ArgumentParser()
    add_flags(parser, experiment.ExperimentFlags)
    return read_flags(experiment.ExperimentFlags, parser.parse_args(arguments))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("knee_left:encoder@8", Fault(module="knee_left", kind="encoder", at=8.0)),
        (
            "knee_left.1:encoder@8.5:0.3",
            Fault(module="knee_left", kind="encoder", at=8.5, axis=1, duration=0.3),
        ),
        ("hip_right:brown_out@2", Fault(module="hip_right", kind="brown_out", at=2.0)),
    ],
)
def test_a_fault_is_read_from_its_flag(text: str, fault: Fault) -> None:
    assert experiment.parse_fault(text) == fault


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_every_kind_of_fault_can_be_asked_for_beside_another(kind: str) -> None:
    flags = ("--fault", f"ankle_left:{kind}@1", "--fault", "hip_left:watchdog@2")
    scenario = experiment.make_scenario(parse(*flags))
    assert [(row.kind, row.at) for row in scenario.fault] == [(kind, 1.0), ("watchdog", 2.0)]
    assert f"ankle_left {kind} at 1 s" in experiment.describe(scenario)


def test_of_many_things_that_happen_the_first_line_names_some_and_counts_the_rest() -> None:
    pushes = [word for at in range(1, 16) for word in ("--push", f"{at}:0.1:10,0,0")]
    words = experiment.describe(experiment.make_scenario(parse("--kill", "planner@1", *pushes)))
    assert words.count("push") == experiment.SHOWN - 1
    assert words.endswith(", and 4 more")


@pytest.mark.parametrize(
    "text", ["toe:encoder@1", "knee_left:fire@1", "knee_left@1", "knee_left.2:encoder@1", "x"]
)
def test_a_fault_that_makes_no_sense_is_refused_with_modules_and_kinds(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=r"ankle_right.*over_temperature"):
        experiment.parse_fault(text)


def test_an_imu_is_not_fitted_to_a_robot_without_a_bus_for_it(tmp_path: Path) -> None:
    """Its log would hold a robot that nothing reads."""
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    bare = tmp_path / "robot.toml"
    bare.write_text(text.replace("[can.imu]", "[can.spare]"), encoding="utf-8")
    shutil.copy(path_beside(DEFAULT_CONFIG), path_beside(bare))
    assert not experiment.load_robot(bare).imu.fitted
    with pytest.raises(ConfigError, match=r"imu\.bus"):
        experiment.load_robot(bare, imu=True)


def test_a_scenario_is_taken_by_name_from_beside_the_robot_file_first(tmp_path: Path) -> None:
    config = tmp_path / "robot.toml"
    assert experiment.scenario_file("squat", config) == SCENARIOS / "squat.toml"
    own = tmp_path / "scenarios"
    own.mkdir()
    shutil.copy(SCENARIOS / "stand.toml", own / "squat.toml")
    shutil.copy(SCENARIOS / "stand.toml", own / "mine.toml")
    assert experiment.scenario_file("squat", config) == own / "squat.toml"
    assert experiment.scenario_file("crawl", config) == SCENARIOS / "crawl.toml"
    with pytest.raises(FleetError, match=r"'nothing'; must be one of .*crawl, .*mine, .*squat"):
        experiment.scenario_file("nothing", config)
