"""The gain schedule beside the robot file: written, read, and refused when it does not fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.gain_schedule import digest_of, inputs_of
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError
from tests.conftest import ROBOT_FILE
from tests.shared.test_config import check_refusal

INPUTS = inputs_of(config_file.load(ROBOT_FILE))


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
    table = msgspec.to_builtins(robot)
    if section == "limits":
        low_high = table["limits"][name]["theta"]
        table["limits"][name]["theta"] = [low_high[0], nudged(low_high[1])]
    elif section == "stand":
        table["stand"][name]["k_d"] = nudged(table["stand"][name]["k_d"])
    else:
        table[section][name] = nudged(table[section][name])
    return msgspec.convert(table, RobotConfig)


def test_a_schedule_comes_back_from_a_file_of_one_node_a_line_that_replaces_an_older_one(
    schedule: GainSchedule, tmp_path: Path
) -> None:
    """So that a change of the schedule can be read in a diff."""
    path = tmp_path / "lab.gains.json"
    assert gain_schedule.read(path) is None, "no file is no error"
    path.write_text("x" * 10**6, encoding="utf-8")
    gain_schedule.write(path, schedule)
    assert gain_schedule.read(path) == schedule
    assert list(tmp_path.iterdir()) == [path]
    lines = path.read_text(encoding="utf-8").splitlines()
    nodes = [line for line in lines if line.lstrip("[ ").startswith(tuple("0123456789"))]
    assert len(nodes) == len(schedule.z) * len(schedule.pitch)
    assert json.loads(path.read_bytes())["version"] == gain_schedule.VERSION


SHIPPED = gain_schedule.path_beside(ROBOT_FILE).read_bytes()


def spoiled(**changes: object) -> bytes:
    return json.dumps(json.loads(SHIPPED) | changes).encode()


def spoiled_bounds(spoil: Callable[[dict[str, Any]], object]) -> bytes:
    table = json.loads(SHIPPED)
    spoil(table["bounds"])
    return json.dumps(table).encode()


NODES = [[[1.0] * 6] * 2] * 2
CORRUPT = {
    "empty": (b"", "(file)", "is not a gain schedule"),
    "cut off": (SHIPPED[:2000], "(file)", "truncated"),
    "five joints": (spoiled(D=[[[1.0] * 5] * 6] * 25), "(file)", "length 6"),
    "not a number": (spoiled(z=[float("nan"), 1.0]), "(file)", "is not a gain schedule"),
    "falling heights": (spoiled(z=[0.9, 0.8], pitch=[0.0, 1.0], D=NODES), "z", "do not increase"),
    "one height": (spoiled(z=[0.9], pitch=[0.0, 1.0], D=NODES[:1]), "z", "do not increase"),
    "a row too few": (spoiled(z=[0.8, 0.9], pitch=[0.0, 1.0], D=NODES[:1]), "D", "does not match"),
    "a row too short": (
        spoiled(z=[0.8, 0.9], pitch=[0.0, 1.0], D=[NODES[0], NODES[0][:1]]), "D", "does not match",
    ),
    "no rows": (spoiled(D=[]), "D", "does not match"),
    # its digest is that of its inputs: nothing later would name the file
    "negative gains": (spoiled(D=[[[-5.0] * 6] * 6] * 25), "D[0][0][0]", "-5.0"),
    "gains that no joint service takes": (spoiled(D=[[[1e9] * 6] * 6] * 25), "D[0][0][0]", "0000"),
    "a kind without bounds": (spoiled_bounds(lambda b: b.pop("knee")), "bounds", "are for ankle"),
    "bounds without a part": (
        spoiled_bounds(lambda b: b["hip"].update(theta=[1.0, 1.0])), "bounds.hip", "is empty",
    ),
    "bounds of no torque": (
        spoiled_bounds(lambda b: b["ankle"].update(tau_ff=[])), "bounds.ankle", "is empty",
    ),
    "a folder": (None, "(file)", "cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("kind", CORRUPT)
def test_a_corrupt_file_is_refused_in_one_line_with_the_command_to_run(
    tmp_path: Path, kind: str
) -> None:
    content, key, found = CORRUPT[kind]
    robot_file = tmp_path / "lab.toml"
    shutil.copy(ROBOT_FILE, robot_file)
    path = tmp_path / "lab.gains.json"
    path.mkdir() if content is None else path.write_bytes(content)
    error = check_refusal(lambda _: config_file.load(robot_file), path, key, found, "xrl gains")
    assert "\n" not in str(error)


def test_the_shipped_schedule_fits_the_robot_however_it_is_read(robot: RobotConfig) -> None:
    assert gain_schedule.why_stale(robot) == ""
    gain_schedule.require(robot, ROBOT_FILE)
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


def test_only_mass_lengths_stiffness_and_limits_are_inputs(robot: RobotConfig) -> None:
    other = changed(
        robot,
        law={"split": "certified", "recentre_s": 9.0},
        planner={"state_stale_ms": 100.0},
        harness={"tare_s": 9.0},
        joint={"encoder_counts_per_turn": 4096},
    )
    assert gain_schedule.why_stale(other) == ""
    assert {
        "mass.payload", "mass.module", "geometry.l1", "geometry.l2", "geometry.harness_point",
        "law.K_p", "law.K_0", "law.S", "certificate.K_required", "assist.force_max",
        "joint_service.k_p_max", "limits.knee",
    } <= set(INPUTS)  # fmt: skip


def test_a_schedule_of_other_inputs_or_another_version_is_stale(
    robot: RobotConfig, schedule: GainSchedule
) -> None:
    """The digest is what counts."""
    other = changed(robot, mass={"payload": 5.0})
    forged = msgspec.structs.replace(schedule, inputs=inputs_of(other))
    other = msgspec.structs.replace(other, gain_schedule=forged)
    assert gain_schedule.why_stale(other) == "the gain schedule's digest does not match its inputs"
    older = msgspec.structs.replace(schedule, version=gain_schedule.VERSION + 1)
    other = msgspec.structs.replace(robot, gain_schedule=older)
    assert "version 3, not 2" in gain_schedule.why_stale(other)


def test_only_the_certified_split_requires_a_schedule_and_that_with_bounds(
    robot: RobotConfig,
) -> None:
    bare = msgspec.structs.replace(robot, gain_schedule=None)
    with pytest.raises(ConfigError) as caught:
        gain_schedule.require(bare, Path("lab.toml"))
    assert str(caught.value) == (
        "lab.gains.json: (file): the gain schedule is missing; run `xrl gains --config lab.toml`"
    )
    gain_schedule.require(changed(bare, law={"split": "diagonal"}), Path("lab.toml"))
    # One by an older `xrl gains`: its joint services would believe anything.
    with pytest.raises(ConfigError, match="no bounds") as refused:
        gain_schedule.require(gain_schedule.believing(robot), Path("lab.toml"))
    assert "xrl gains --config lab.toml" in str(refused.value)
