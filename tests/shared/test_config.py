from __future__ import annotations

import copy
import functools
import math
import operator
import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import can
import msgspec
import pytest
import tomli_w

from shared.config import files as config_file
from shared.config.checks import INTERFACES
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Fault, Scenario
from shared.exceptions import ConfigError
from shared.toml_file import Range
from tests.conftest import ROBOT_FILE

Table = dict[str, Any]
Change = Callable[[Table], object]
TEXT = ROBOT_FILE.read_text(encoding="utf-8")
RAW: Table = tomllib.loads(TEXT)


def changed_file(path: Path, table: Table, change: Change) -> Path:
    """Write a table as TOML after one change."""
    raw = copy.deepcopy(table)
    change(raw)
    assert raw != table
    path.write_text(tomli_w.dumps(raw), encoding="utf-8")
    return path


def load_changed(tmp_path: Path, change: Change) -> RobotConfig:
    """Load the shipped robot after one change."""
    return config_file.load(changed_file(tmp_path / "robot.toml", RAW, change))


def check_refusal(
    load: Callable[[Path], object], path: Path, key: str, found: str, right: str
) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        load(path)
    error = caught.value
    assert (error.file, error.key) == (str(path), key)
    assert found in error.found
    assert right in error.expected
    for part in (error.file, error.key, error.found, error.expected):
        assert part in str(error)
    return error


def place(table: Any, dotted: str) -> tuple[Any, Any]:
    """Return what holds a dotted key, and its key there; a number in it is an index."""
    *path, last = [int(part) if part.isdigit() else part for part in dotted.split(".")]
    return functools.reduce(operator.getitem, path, table), last


def setting(dotted: str, value: object) -> Change:
    return lambda raw: operator.setitem(*place(raw, dotted), value)


def without(dotted: str) -> Change:
    return lambda raw: operator.delitem(*place(raw, dotted))


Refusal = tuple[Change, str, str, str]
"""Change; the key that the error names; what stands there; a word of what would be right."""


def refusal(dotted: str, value: object, found: str, right: str) -> Refusal:
    """Return the refusal of one key's value."""
    return setting(dotted, value), re.sub(r"\.(\d+)", r"[\1]", dotted), found, right


def on_one_bus(raw: Table) -> None:
    raw["module"][1] |= {"bus": "ankle_right", "node_ids": [1, 2]}


REFUSALS: list[Refusal] = [
    # unknown and missing keys
    refusal("wheels", 4, "unknown", "spelling"),
    refusal("simulation.operator.k_x", 1.0, "unknown", "spelling"),
    (without("mass.battery"), "mass.battery", "missing", "required"),
    # types and sizes
    refusal("mass.payload", "heavy", "'heavy'", "float"),
    refusal("law.K_p", [1.0] * 5, "[1.0, 1.0, 1.0, 1.0, 1.0]", "length 6"),
    refusal("module.1.node_ids.1", "x", "'x'", "int"),
    refusal("law.S.2", 7, "7", "must be one of 0, 1"),
    refusal("can.harness.speed", 3, "unknown", "spelling"),
    # choices
    refusal("law.jacobian", "mean", "'mean'", "load_sharing"),
    refusal("law.S.0", 1, "the robot would not balance", "only z and pitch"),
    # ranges
    refusal("mass.battery", -0.9, "-0.9", "0 to 200 kg"),
    refusal("mass.payload", math.nan, "nan", "0 to 200 kg"),
    refusal("mass.payload", math.inf, "inf", "0 to 200 kg"),
    refusal("module.3.node_ids.0", 63, "63", "0 to 62"),
    # names
    refusal("name", "a/b", "'a/b'", "letters"),
    refusal("module.0.name", "toe", "'toe'", "ankle_right, knee_right"),
    refusal("module.1.name", "ankle_right", "'ankle_right'", "once"),
    (lambda raw: raw["module"].pop(), "module", "hip_left", "six modules"),
    (lambda raw: raw["module"].append(RAW["module"][0]), "module[6].name", "twice", "once"),
    refusal("module.4.bus", "can9", "'can9'", "one of ankle_right"),
    refusal("supply.sit_v", 45.0, "45 V", "at most supply.low_v, 44 V"),
    refusal("harness.bus", "can9", "'can9'", "one of ankle_right"),
    (lambda raw: raw["imu"].update(fitted=True, bus="can9"), "imu.bus", "'can9'", "one of ankle"),
    (
        lambda raw: raw["imu"].update(fitted=True, bus="hip_left"),
        "imu.bus",
        "'hip_left' is also the bus of hip_left",
        "a bus without drives",
    ),
    refusal("module.1.node_ids", [2, 2], "node 2", "free"),
    (on_one_bus, "module[1].node_ids", "node 1", "free"),
    (without("bus.endpoints.planner"), "bus.endpoints.planner", "missing", "each service"),
    refusal("bus.endpoints.wheel", "tcp/a:1", "not a valid service", "recorder"),
    refusal("bus.endpoints.planner", "tcp/a:x", "", "HOST:PORT"),
    refusal("bus.endpoints.planner", "udp/a:1", "'udp/a:1'", "tcp/"),
    refusal("bus.endpoints.planner", "tcp/a:65536", "", "1 to 65535"),
    refusal("bus.security.keys", "~/{Robot}", "{Robot} is", "{robot}"),
    refusal(
        "bus.endpoints.planner",
        "unixsock-stream/{Run}/planner.zenoh",
        "{Run} is not a valid placeholder",
        "only {run}",
    ),
    (
        lambda raw: raw.update(ros2={"router": "tcp/a:99999"}),
        "ros2.router",
        "99999",
        "localhost:7447",
    ),
    refusal(
        "bus.endpoints.harness", RAW["bus"]["endpoints"]["planner"], "planner", "another endpoint"
    ),
    (setting("assumed", ["mass.module", "mass.wheel"]), "assumed[1]", "'mass.wheel'", "key"),
    *(
        (setting("assumed", [key]), "assumed[0]", f"'{key}'", "key")
        for key in ("wheels", "torso_mass", "module_named", "mass.__class__", "can.keys")
    ),
    # physics
    refusal("mass.payload", 20.5, "20.5", "at most 20.4 kg"),
    refusal("limits.hip.phi", [1.0, -1.0], "[1, -1]", "lower limit must be below"),
    refusal("limits.ankle.theta", [0.9, 0.9], "0.9", "lower limit must be below"),
    refusal("limits.knee.theta.1", 0.0, "0 rad", "negative"),
    refusal("limits.knee.theta.1", 0.1, "0.1 rad", "negative"),
    refusal("simulation.stand_height", 1.3, "1.3", "0.762 to 1.296"),
    refusal("simulation.stand_height", 0.76, "0.76", "0.762 to"),
    refusal("law.K_p.0", 0.0, "0 in a direction", "positive"),
    refusal("geometry.l1", 1.1, "1.1 m", "shorter than the shin"),
    refusal("drive.current_lim", 5.0, "5 A", "at least 39.9 A"),
    refusal("drive.current_lim", 60.5, "60.5 A", "at most 60 A"),
    refusal("drive.vel_limit", 2.0, "2 turn/s", "must be at least 55.7 turn/s"),
    (setting("joint_service.v_max", 22.0), "drive.vel_limit", "60 turn/s", "at least 61.3"),
    refusal("drive.zero_mark_turns", 8.0, "8 turns: the hip", "41"),
    refusal("drive.zero_mark_turns", 0.0, "lost power", "41"),
    (setting("joint.gear_ratio", 30.0), "drive.vel_limit", "60 turn/s", "at least 95.5"),
    refusal("can.harness.interface", "socketcam", "'socketcam'", "did you mean 'socketcan'?"),
    refusal("drive.watchdog_timeout", 0.1, "0.1 s would disarm", "must be 0 s"),
    (setting("joint_service.loop", "service"), "drive.watchdog_timeout", "0 s", "at least 0.02"),
    refusal("drive.encoder_period_ms", 10, "10 ms", "2 ms"),
    refusal("simulation.encoder_rate_hz", 50.0, "50 Hz", "must be 500 Hz"),
    refusal("joint_service.state_rate_hz", 300.0, "300", "whole"),
    # timing
    refusal("joint_service.state_rate_hz", 501.0, "501", "500"),
    refusal("planner.rate_hz", 251.0, "251", "at most 250"),
    refusal("joint_service.command_aging_max_ms", 51.0, "51", "at most 50"),
    refusal("joint_service.engage_after_ms", 3201.0, "3201", "at most 3200"),
]


@pytest.mark.parametrize(
    ("change", "key", "found", "right"), REFUSALS, ids=[f"{r[1]}-{r[2]}" for r in REFUSALS]
)
def test_a_refusal_names_file_key_value_and_what_would_be_right(
    tmp_path: Path, change: Change, key: str, found: str, right: str
) -> None:
    path = changed_file(tmp_path / "robot.toml", RAW, change)
    check_refusal(config_file.load, path, key, found, right)


@pytest.mark.parametrize("kind", ["absent", "directory", "not toml", "not text"])
def test_a_file_that_cannot_be_read_is_refused_by_name(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "robot.toml"
    if kind == "directory":
        path.mkdir()
    elif kind == "not toml":
        path.write_text("name = = 3", encoding="utf-8")
    elif kind == "not text":
        path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError) as caught:
        config_file.load(path)
    assert str(path) in str(caught.value)
    assert "TOML" in caught.value.expected


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mass.payload", 0.0),
        ("mass.payload_max", 20.5),
        ("drive.current_lim", 60.0),
        ("drive.vel_limit", 55.8),
        ("drive.zero_mark_turns", 41.0),
        ("can.harness.interface", "socketcan"),
        ("can.harness.interface", "slcan"),
        ("simulation.can_dialect", "0.6"),
        ("assumed", ("law.K_p", "limits.knee.theta", "can.harness.channel")),
    ],
)
def test_what_a_robot_can_do_and_python_can_knows_is_taken(
    tmp_path: Path, key: str, value: object
) -> None:
    taken = msgspec.to_builtins(load_changed(tmp_path, setting(key, value)))
    assert operator.getitem(*place(taken, key)) == value


# ---- ranges

BESIDE = ("gain_schedule", "axis", "duration")
"""Not of the robot's file; what a fault may leave out: each has its own tests."""


def is_bound(note: object) -> bool:
    return isinstance(note, Range) and -1e12 < note.low <= note.high < 1e12


def numbers_without_a_range(hint: Any, where: str, in_range: bool = False) -> Iterator[str]:
    """Yield the path of every number below a type hint that no Range bounds to less than 1e12."""
    origin = get_origin(hint)
    if origin is Annotated:
        inner, *notes = get_args(hint)
        yield from numbers_without_a_range(inner, where, any(map(is_bound, notes)))
    elif origin in (tuple, dict):
        for index, item in enumerate(get_args(hint)):
            if item is not Ellipsis:
                yield from numbers_without_a_range(item, f"{where}[{index}]")
    elif origin in (Union, UnionType) and Annotated in map(get_origin, get_args(hint)):
        for item in get_args(hint):
            yield from numbers_without_a_range(item, where)
    elif isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        for name, field in get_type_hints(hint, include_extras=True).items():
            if name not in BESIDE or (hint is not Fault and name != BESIDE[0]):
                yield from numbers_without_a_range(field, f"{where}.{name}")
    elif hint in (int, float):
        if not in_range:
            yield where
    else:
        assert origin is Literal or hint in (str, bool, NoneType), f"{where}: {hint} is not checked"


def test_every_number_of_a_robot_and_a_scenario_has_a_range() -> None:
    assert list(numbers_without_a_range(RobotConfig, "robot")) == []
    assert list(numbers_without_a_range(Scenario, "scenario")) == []

    class Bare(msgspec.Struct):
        pair: tuple[Annotated[float, Range(0.0, 1.0, "m")], float]
        wide: Annotated[float, Range(0.0, math.inf, "m")]

    assert list(numbers_without_a_range(Bare, "bare")) == ["bare.pair[1]", "bare.wide"]


# ---- what is read


def test_a_robot_comes_back_from_its_own_toml_and_from_text_without_a_schedule(
    robot: RobotConfig, tmp_path: Path
) -> None:
    assert robot.gain_schedule is not None
    path = tmp_path / "again.toml"
    path.write_text(config_file.to_toml(robot), encoding="utf-8")
    assert config_file.load(path).gain_schedule is None
    shutil.copy(ROBOT_FILE.with_name("robot.gains.json"), tmp_path / "again.gains.json")
    assert config_file.load(path) == robot
    parsed = config_file.parse(TEXT, "robot.toml of a log")
    assert parsed == msgspec.structs.replace(robot, gain_schedule=None)
    with pytest.raises(ConfigError, match=r"robot\.toml of a log"):
        config_file.parse("name = 3", "robot.toml of a log")


def test_masses_and_joint_limits_are_those_of_the_file_and_all_interfaces_are_known(
    robot: RobotConfig,
) -> None:
    assert (robot.torso_mass, robot.total_mass) == pytest.approx((39.66, 74.58))
    rows = robot.joint_limits()
    assert len(rows) == 12
    assert rows[:6] == rows[6:]
    assert rows[2:4] == (robot.limits.knee.phi, robot.limits.knee.theta)
    assert set(INTERFACES) == set(can.VALID_INTERFACES)


def test_the_file_of_the_person_who_wears_it_stands_beside_the_robot_file(tmp_path: Path) -> None:
    robot_file, wearer = tmp_path / "lab.toml", tmp_path / "lab.wearer.toml"
    robot_file.write_text(ROBOT_FILE.read_text())
    wearer.write_text("open_n = 31.0\nopen_back_nm = 7.5\nstill_s = 0.6\n")
    park = config_file.load(robot_file).park
    assert (park.open_n, park.open_back_nm, park.still_s) == (31.0, 7.5, 0.6)
    assert park.enabled == config_file.load(ROBOT_FILE).park.enabled
    wearer.write_text("open_n = 31.0\n")
    with pytest.raises(ConfigError, match=r"lab\.wearer\.toml: open_back_nm: missing"):
        config_file.load(robot_file)
    wearer.write_text("open_n = 310.0\nopen_back_nm = 7.5\nstill_s = 0.6\n")
    with pytest.raises(ConfigError, match=r"lab\.wearer\.toml: open_n: 310"):
        config_file.load(robot_file)
