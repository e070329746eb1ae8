"""The gain schedule beside the robot file: written, read, and refused when it does not fit."""

from __future__ import annotations

import copy
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomli_w

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.gain_schedule import digest_of, inputs_of
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError
from tests.conftest import ROBOT_FILE

INPUTS = inputs_of(config_file.load(ROBOT_FILE))


@pytest.fixture
def schedule(robot: RobotConfig) -> GainSchedule:
    assert robot.gain_schedule is not None
    return robot.gain_schedule


def changed(robot: RobotConfig, **sections: dict[str, object]) -> RobotConfig:
    """Return the robot with keys of its tables changed, the schedule as it was."""
    parts = {
        name: msgspec.structs.replace(getattr(robot, name), **keys)
        for name, keys in sections.items()
    }
    return msgspec.structs.replace(robot, **parts)


def nudged(value: Any) -> Any:
    """Return a value a little off; of a row, with its first number off."""
    if isinstance(value, (list, tuple)):
        return [nudged(value[0]), *value[1:]]
    if isinstance(value, str):
        return {"load_sharing": "average", "ankle": "knee"}[value]
    return 1 - value if value in (0, 1) else value * 1.0625


def with_input_nudged(robot: RobotConfig, key: str) -> RobotConfig:
    """Return the robot with one of the schedule's inputs a little off."""
    section, name = key.split(".")
    table = copy.deepcopy(msgspec.to_builtins(robot))
    if section == "limits":
        low_high = table["limits"][name]["theta"]
        table["limits"][name]["theta"] = [low_high[0], nudged(low_high[1])]
    elif section == "stand":
        table["stand"][name]["k_d"] = nudged(table["stand"][name]["k_d"])
    else:
        table[section][name] = nudged(table[section][name])
    return msgspec.convert(table, RobotConfig)


# -- the file --------------------------------------------------------------------------


def test_a_schedule_comes_back_from_its_file(schedule: GainSchedule, tmp_path: Path) -> None:
    path = tmp_path / "lab.gains.json"
    gain_schedule.write(path, schedule)
    assert gain_schedule.read(path) == schedule
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_holds_one_node_a_line(schedule: GainSchedule, tmp_path: Path) -> None:
    """So that a change of the schedule can be read in a diff."""
    path = tmp_path / "lab.gains.json"
    gain_schedule.write(path, schedule)
    lines = path.read_text(encoding="utf-8").splitlines()
    nodes = [line for line in lines if line.lstrip("[ ").startswith(tuple("0123456789"))]
    assert len(nodes) == len(schedule.z) * len(schedule.pitch)
    assert json.loads(path.read_text(encoding="utf-8"))["version"] == gain_schedule.VERSION


def test_writing_replaces_an_older_file_whole(schedule: GainSchedule, tmp_path: Path) -> None:
    path = tmp_path / "lab.gains.json"
    path.write_text("x" * 10**6, encoding="utf-8")
    gain_schedule.write(path, schedule)
    assert gain_schedule.read(path) == schedule


def test_a_folder_that_is_not_there_is_one_line(schedule: GainSchedule, tmp_path: Path) -> None:
    path = tmp_path / "none" / "lab.gains.json"
    with pytest.raises(ConfigError, match="cannot be written: No such file") as caught:
        gain_schedule.write(path, schedule)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("robot_file", "beside"), [("lab.toml", "lab.gains.json"), ("a/b.v2.toml", "a/b.v2.gains.json")]
)
def test_the_schedule_lies_beside_the_robot_file(robot_file: str, beside: str) -> None:
    assert gain_schedule.path_beside(Path(robot_file)) == Path(beside)


def test_no_file_is_no_schedule_and_no_error(tmp_path: Path) -> None:
    assert gain_schedule.read(tmp_path / "lab.gains.json") is None


def spoiled(**changes: object) -> bytes:
    table = json.loads(gain_schedule.path_beside(ROBOT_FILE).read_bytes())
    return json.dumps(table | changes).encode()


NODES = [[[1.0] * 6] * 2] * 2
CORRUPT = {
    "empty": (b"", "(file)", "is no gain schedule"),
    "cut off": (gain_schedule.path_beside(ROBOT_FILE).read_bytes()[:2000], "(file)", "truncated"),
    "no text": (b"\xff\xfe\x00", "(file)", "is no gain schedule"),
    "no table": (b"[1, 2]", "(file)", "Expected `object`"),
    "empty table": (b"{}", "(file)", "missing required field `version`"),
    "unknown key": (spoiled(wheels=4), "(file)", "wheels"),
    "five joints": (spoiled(D=[[[1.0] * 5] * 6] * 25), "(file)", "length 6"),
    "a word": (spoiled(D=[[["stiff"] * 6] * 6] * 25), "(file)", "Expected `float`"),
    "not a number": (spoiled(z=[float("nan"), 1.0]), "(file)", "is no gain schedule"),
    "falling heights": (spoiled(z=[0.9, 0.8], pitch=[0.0, 1.0], D=NODES), "z", "do not rise"),
    "equal heights": (spoiled(z=[0.9, 0.9], pitch=[0.0, 1.0], D=NODES), "z", "do not rise"),
    "falling pitches": (spoiled(z=[0.8, 0.9], pitch=[1.0, 0.0], D=NODES), "pitch", "do not rise"),
    "one height": (spoiled(z=[0.9], pitch=[0.0, 1.0], D=NODES[:1]), "z", "do not rise"),
    "a row too few": (spoiled(z=[0.8, 0.9], pitch=[0.0, 1.0], D=NODES[:1]), "D", "does not fit"),
    "a row too short": (
        spoiled(z=[0.8, 0.9], pitch=[0.0, 1.0], D=[NODES[0], NODES[0][:1]]), "D", "does not fit",
    ),
    "no rows": (spoiled(D=[]), "D", "does not fit"),
}  # fmt: skip


@pytest.mark.parametrize("kind", CORRUPT)
def test_a_corrupt_file_is_refused_in_one_line_with_the_command_to_run(
    tmp_path: Path, kind: str
) -> None:
    content, key, found = CORRUPT[kind]
    robot_file = tmp_path / "lab.toml"
    shutil.copy(ROBOT_FILE, robot_file)
    path = tmp_path / "lab.gains.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        config_file.load(robot_file)
    error = caught.value
    assert (error.file, error.key) == (str(path), key)
    assert found in error.found
    assert "xrl gains" in error.expected
    assert "\n" not in str(error)


@pytest.mark.parametrize("bad", [-5.0, 1e9])
def test_gains_that_no_joint_service_would_take_are_refused(tmp_path: Path, bad: float) -> None:
    """Its digest is that of its inputs: nothing later would name the file."""
    path = tmp_path / "lab.gains.json"
    path.write_bytes(spoiled(D=[[[bad] * 6] * 6] * 25))
    with pytest.raises(ConfigError, match="xrl gains"):
        gain_schedule.read(path)


def test_a_folder_in_its_place_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "lab.gains.json"
    path.mkdir()
    with pytest.raises(ConfigError, match="cannot be read"):
        gain_schedule.read(path)


# -- does it fit? ----------------------------------------------------------------------


def test_the_shipped_schedule_fits_the_shipped_robot(robot: RobotConfig) -> None:
    assert gain_schedule.why_stale(robot) == ""
    gain_schedule.require(robot, ROBOT_FILE)


def test_a_robot_read_from_its_own_toml_has_the_same_digest(robot: RobotConfig) -> None:
    again = config_file.parse(config_file.to_toml(robot), "again.toml")
    assert digest_of(inputs_of(again)) == digest_of(inputs_of(robot))


@pytest.mark.parametrize("key", INPUTS)
def test_every_input_that_differs_is_named_with_both_values(robot: RobotConfig, key: str) -> None:
    other = with_input_nudged(robot, key)
    inputs = inputs_of(other)
    assert [name for name, value in inputs.items() if value != INPUTS[name]] == [key]
    assert digest_of(inputs) != digest_of(INPUTS)
    expected = f"the gain schedule was made for {key} = {INPUTS[key]}, not {inputs[key]}"
    assert gain_schedule.why_stale(other) == expected


def test_mass_lengths_stiffness_and_limits_are_among_the_inputs() -> None:
    assert {
        "mass.payload", "mass.module", "geometry.l1", "geometry.l2", "geometry.harness_point",
        "law.K_p", "law.K_0", "law.S", "certificate.K_required", "assist.force_max",
        "joint_service.k_p_max", "limits.knee",
    } <= set(INPUTS)  # fmt: skip


def test_what_the_schedule_does_not_depend_on_leaves_it_fitting(robot: RobotConfig) -> None:
    other = changed(
        robot,
        law={"split": "certified", "recentre_s": 9.0},
        planner={"state_stale_ms": 100.0},
        harness={"tare_s": 9.0},
        joint={"encoder_counts_per_turn": 4096},
    )
    assert gain_schedule.why_stale(other) == ""


def test_a_schedule_whose_inputs_were_edited_by_hand_is_stale(
    robot: RobotConfig, schedule: GainSchedule
) -> None:
    """The digest is what counts."""
    other = changed(robot, mass={"payload": 5.0})
    forged = msgspec.structs.replace(schedule, inputs=inputs_of(other))
    other = msgspec.structs.replace(other, gain_schedule=forged)
    assert gain_schedule.why_stale(other) == "the gain schedule's digest is not that of its inputs"


def test_another_version_is_stale(robot: RobotConfig, schedule: GainSchedule) -> None:
    older = msgspec.structs.replace(schedule, version=gain_schedule.VERSION + 1)
    other = msgspec.structs.replace(robot, gain_schedule=older)
    assert "version 3, not 2" in gain_schedule.why_stale(other)


def test_a_schedule_without_bounds_is_refused_with_the_command_to_run(robot: RobotConfig) -> None:
    """One by an older `xrl gains`: its joint services would believe anything."""
    with pytest.raises(ConfigError, match="no bounds") as refused:
        gain_schedule.require(gain_schedule.believing(robot), Path("lab.toml"))
    assert "xrl gains --config lab.toml" in str(refused.value)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda bounds: bounds.pop("knee"), "bounds"),
        (lambda bounds: bounds["hip"].update(theta=[1.0, 1.0]), "bounds.hip"),
        (lambda bounds: bounds["ankle"].update(tau_ff=[]), "bounds.ankle"),
    ],
)
def test_bounds_that_no_joint_service_can_use_are_refused(
    tmp_path: Path, spoil: Callable[[dict[str, Any]], object], words: str
) -> None:
    path = tmp_path / "lab.gains.json"
    table = json.loads(gain_schedule.path_beside(ROBOT_FILE).read_bytes())
    spoil(table["bounds"])
    path.write_text(json.dumps(table), encoding="utf-8")
    with pytest.raises(ConfigError, match=words) as refused:
        gain_schedule.read(path)
    assert "xrl gains" in str(refused.value)


def test_only_the_certified_split_requires_a_schedule(robot: RobotConfig) -> None:
    bare = msgspec.structs.replace(robot, gain_schedule=None)
    with pytest.raises(ConfigError) as caught:
        gain_schedule.require(bare, Path("lab.toml"))
    assert str(caught.value) == (
        "lab.gains.json: (file): there is no gain schedule; run `xrl gains --config lab.toml`"
    )
    gain_schedule.require(changed(bare, law={"split": "diagonal"}), Path("lab.toml"))


def test_a_planner_with_a_stale_schedule_refuses_to_start_with_the_command_to_run(
    tmp_path: Path,
) -> None:
    robot_file = tmp_path / "lab.toml"
    table = msgspec.to_builtins(config_file.load(ROBOT_FILE))
    del table["gain_schedule"]
    table["mass"]["payload"] = 12.5
    robot_file.write_text(tomli_w.dumps(table), encoding="utf-8")
    shutil.copy(gain_schedule.path_beside(ROBOT_FILE), tmp_path / "lab.gains.json")
    command = [sys.executable, "-m", "services.planner", "--config", str(robot_file)]
    done = subprocess.run(
        [*command, "--run-dir", str(tmp_path / "r")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "mass.payload = 20.4, not 12.5" in done.stderr
    assert f"run `xrl gains --config {robot_file}`" in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "r").exists()
