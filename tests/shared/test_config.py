from __future__ import annotations

import copy
import functools
import math
import operator
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


def on_one_bus(raw: Table) -> None:
    raw["module"][1] |= {"bus": "ankle_right", "node_ids": [1, 2]}


# change; the key the error names; what stands there; a word of what would be right
REFUSALS: list[tuple[Change, str, str, str]] = [
    # unknown and missing keys
    (setting("wheels", 4), "wheels", "unknown", "spelling"),
    (setting("mass.wheel", 1.0), "mass.wheel", "unknown", "spelling"),
    (setting("module.2.colour", "red"), "module[2].colour", "unknown", "spelling"),
    (setting("simulation.operator.k_x", 1.0), "simulation.operator.k_x", "unknown", "spelling"),
    (without("mass"), "mass", "missing", "required"),
    (without("mass.battery"), "mass.battery", "missing", "required"),
    (without("limits.knee.why"), "limits.knee.why", "missing", "required"),
    # types and sizes
    (setting("mass.payload", "heavy"), "mass.payload", "'heavy'", "float"),
    (setting("joint.gear_ratio", True), "joint.gear_ratio", "True", "float"),
    (setting("drive.encoder_period_ms", 2.5), "drive.encoder_period_ms", "2.5", "int"),
    (setting("mass", 3), "mass", "3", "object"),
    (setting("law.K_p", [1.0] * 5), "law.K_p", "[1.0, 1.0, 1.0, 1.0, 1.0]", "length 6"),
    (setting("module.1.node_ids", [2, 3, 4]), "module[1].node_ids", "[2, 3, 4]", "length 2"),
    (setting("module.1.node_ids.1", "x"), "module[1].node_ids[1]", "'x'", "int"),
    (setting("law.S.2", 7), "law.S[2]", "7", "one of 0, 1"),
    # an entry of a free table
    (setting("can.harness.interface", 3), "can.harness.interface", "3", "str"),
    (setting("can.harness.speed", 3), "can.harness.speed", "unknown", "spelling"),
    (without("can.harness.channel"), "can.harness.channel", "missing", "required"),
    (setting("bus.endpoints.planner", 3), "bus.endpoints.planner", "3", "str"),
    # choices
    (setting("law.jacobian", "mean"), "law.jacobian", "'mean'", "load_sharing"),
    (setting("law.split", "paper"), "law.split", "'paper'", "certified, diagonal"),
    (setting("joint_service.driver", "usb"), "joint_service.driver", "'usb'", "odrive_can"),
    (setting("simulation.can_dialect", "0.7"), "simulation.can_dialect", "'0.7'", "0.5, 0.6"),
    (setting("law.S.0", 1), "law.S[0]", "nobody would balance", "only z and pitch"),
    # ranges
    (setting("mass.battery", -0.9), "mass.battery", "-0.9", "0 to 200 kg"),
    (setting("mass.module", 0.0), "mass.module", "0.0", "0.1 to 50 kg"),
    (setting("mass.payload", math.nan), "mass.payload", "nan", "0 to 200 kg"),
    (setting("mass.payload", math.inf), "mass.payload", "inf", "0 to 200 kg"),
    (setting("geometry.torso_size.2", 9.0), "geometry.torso_size[2]", "9.0", "2 m"),
    (setting("law.K_p.5", -1.0), "law.K_p[5]", "-1.0", "N m/rad"),
    (setting("certificate.K_required.0", 0.0), "certificate.K_required[0]", "0.0", "N/m"),
    (setting("certificate.margin_min", 1.5), "certificate.margin_min", "1.5", "0 to 1"),
    (setting("module.3.node_ids.0", 63), "module[3].node_ids[0]", "63", "0 to 62"),
    (setting("joint_service.rate_hz", 0.0), "joint_service.rate_hz", "0.0", "Hz"),
    (setting("simulation.operator.k_z", -1.0), "simulation.operator.k_z", "-1.0", "N/m"),
    # names
    (setting("name", "a/b"), "name", "'a/b'", "letters"),
    (setting("module.0.name", "toe"), "module[0].name", "'toe'", "ankle_right, knee_right"),
    (setting("module.1.name", "ankle_right"), "module[1].name", "'ankle_right'", "once"),
    (lambda raw: raw["module"].pop(), "module", "hip_left", "six modules"),
    (lambda raw: raw["module"].append(RAW["module"][0]), "module[6].name", "twice", "once"),
    (setting("module.4.bus", "can9"), "module[4].bus", "'can9'", "one of ankle_right"),
    (setting("supply.sit_v", 45.0), "supply.sit_v", "45 V", "at most supply.low_v, 44 V"),
    (setting("harness.bus", "can9"), "harness.bus", "'can9'", "one of ankle_right"),
    (lambda raw: raw["imu"].update(fitted=True, bus="can9"), "imu.bus", "'can9'", "one of ankle"),
    (
        lambda raw: raw["imu"].update(fitted=True, bus="hip_left"),
        "imu.bus",
        "'hip_left' is hip_left's bus too",
        "one without drives",
    ),
    (setting("module.1.node_ids", [2, 2]), "module[1].node_ids", "node 2", "free"),
    (on_one_bus, "module[1].node_ids", "node 1", "free"),
    (without("bus.endpoints.planner"), "bus.endpoints.planner", "missing", "each service"),
    (setting("bus.endpoints.wheel", "tcp/a:1"), "bus.endpoints.wheel", "no such", "recorder"),
    (setting("bus.endpoints.planner", "tls/10.0.0.1"), "bus.endpoints.planner", "", "HOST:PORT"),
    (setting("bus.endpoints.planner", "tcp/a:x"), "bus.endpoints.planner", "", "HOST:PORT"),
    (setting("bus.endpoints.planner", "udp/a:1"), "bus.endpoints.planner", "'udp/a:1'", "tcp/"),
    (setting("bus.endpoints.planner", "tcp/a:65536"), "bus.endpoints.planner", "", "1 to 65535"),
    (setting("bus.security.keys", "~/{Robot}"), "bus.security.keys", "{Robot} is", "{robot}"),
    (setting("bus.endpoints.planner", "tcp/a:0"), "bus.endpoints.planner", "", "1 to 65535"),
    (
        setting("bus.endpoints.planner", "unixsock-stream/{Run}/planner.zenoh"),
        "bus.endpoints.planner",
        "{Run} is no placeholder",
        "only {run}",
    ),
    (setting("can.hip_left.channel", "{rum}/x.sock"), "can.hip_left.channel", "{rum} is", "{run}"),
    (
        lambda raw: raw.update(ros2={"router": "tcp/a:99999"}),
        "ros2.router",
        "99999",
        "localhost:7447",
    ),
    (
        setting("bus.endpoints.harness", RAW["bus"]["endpoints"]["planner"]),
        "bus.endpoints.harness",
        "planner",
        "one for each",
    ),
    (setting("assumed", ["mass.module", "mass.wheel"]), "assumed[1]", "'mass.wheel'", "key"),
    *(
        (setting("assumed", [key]), "assumed[0]", f"'{key}'", "key")
        for key in ("wheels", "torso_mass", "module_named", "mass.__class__", "can.keys")
    ),
    # physics
    (setting("mass.payload", 20.5), "mass.payload", "20.5", "at most 20.4 kg"),
    (setting("limits.hip.phi", [1.0, -1.0]), "limits.hip.phi", "[1, -1]", "low below high"),
    (setting("limits.ankle.theta", [0.9, 0.9]), "limits.ankle.theta", "0.9", "low below high"),
    (setting("limits.knee.theta.1", 0.0), "limits.knee.theta[1]", "0 rad", "negative"),
    (setting("limits.knee.theta.1", 0.1), "limits.knee.theta[1]", "0.1 rad", "negative"),
    (setting("simulation.stand_height", 1.3), "simulation.stand_height", "1.3", "0.762 to 1.296"),
    (setting("simulation.stand_height", 0.76), "simulation.stand_height", "0.76", "0.762 to"),
    (setting("law.K_p.0", 0.0), "law.K_p[0]", "0 in a direction", "positive"),
    (setting("geometry.l1", 1.1), "geometry.l1", "1.1 m", "shorter than the shin"),
    (setting("drive.current_lim", 5.0), "drive.current_lim", "5 A", "at least 39.9 A"),
    (setting("drive.current_lim", 60.5), "drive.current_lim", "60.5 A", "at most 60 A"),
    (setting("drive.vel_limit", 2.0), "drive.vel_limit", "2 turn/s", "at least 55.7 turn/s"),
    (setting("joint_service.v_max", 22.0), "drive.vel_limit", "60 turn/s", "at least 61.3"),
    (setting("drive.zero_mark_turns", 8.0), "drive.zero_mark_turns", "8 turns: the hip", "41"),
    (setting("drive.zero_mark_turns", 0.0), "drive.zero_mark_turns", "had no power", "41"),
    (setting("joint.gear_ratio", 30.0), "drive.vel_limit", "60 turn/s", "at least 95.5"),
    (
        setting("can.harness.interface", "socketcam"),
        "can.harness.interface",
        "'socketcam'",
        "did you mean 'socketcan'?",
    ),
    (
        setting("can.hip_left.interface", "wires"),
        "can.hip_left.interface",
        "'wires'",
        "one of canalystii, ",
    ),
    (setting("drive.watchdog_timeout", 0.1), "drive.watchdog_timeout", "0.1 s disarms", "0 s: off"),
    (setting("joint_service.loop", "service"), "drive.watchdog_timeout", "0 s", "at least 0.02"),
    (setting("drive.encoder_period_ms", 10), "drive.encoder_period_ms", "10 ms", "2 ms"),
    (
        setting("simulation.encoder_rate_hz", 50.0),
        "simulation.encoder_rate_hz",
        "50 Hz",
        "500 Hz: they are its clock",
    ),
    (setting("joint_service.state_rate_hz", 300.0), "joint_service.state_rate_hz", "300", "whole"),
    # timing
    (setting("joint_service.state_rate_hz", 501.0), "joint_service.state_rate_hz", "501", "500"),
    (setting("planner.rate_hz", 251.0), "planner.rate_hz", "251", "at most 250"),
    (
        setting("joint_service.command_aging_max_ms", 51.0),
        "joint_service.command_aging_max_ms",
        "51",
        "at most 50",
    ),
    (
        setting("joint_service.engage_after_ms", 3201.0),
        "joint_service.engage_after_ms",
        "3201",
        "at most 3200",
    ),
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


def test_the_interfaces_that_python_can_knows_are_all_there() -> None:
    assert set(INTERFACES) == set(can.VALID_INTERFACES)


# ---- ranges

BESIDE = ("gain_schedule", "axis", "duration")
"""Not of the robot's file; what a fault may leave out: each has its own tests."""


def numbers_without_a_range(hint: Any, where: str, in_range: bool = False) -> Iterator[str]:
    """Yield the path of every number below a type hint that no Range bounds."""
    origin = get_origin(hint)
    if origin is Annotated:
        inner, *notes = get_args(hint)
        yield from numbers_without_a_range(inner, where, any(isinstance(n, Range) for n in notes))
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


def test_a_number_without_a_range_would_be_found() -> None:
    class Bare(msgspec.Struct):
        pair: tuple[Annotated[float, Range(0.0, 1.0, "m")], float]

    assert list(numbers_without_a_range(Bare, "bare")) == ["bare.pair[1]"]


def numbers_in(value: Any, key: str) -> Iterator[str]:
    """Yield the dotted key of every number of a TOML table; choices of 0 or 1 are none."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from numbers_in(item, f"{key}.{name}".lstrip("."))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from numbers_in(item, f"{key}.{index}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield key


@pytest.mark.parametrize("huge", [1e12, -1e12])
def test_every_number_of_the_file_is_refused_when_it_is_absurd(tmp_path: Path, huge: float) -> None:
    keys = list(numbers_in(RAW, ""))
    assert len(keys) > 100
    for key in keys:
        is_whole = isinstance(operator.getitem(*place(RAW, key)), int)
        absurd = int(huge) if is_whole else huge
        with pytest.raises(ConfigError) as caught:
            load_changed(tmp_path, setting(key, absurd))
        named = caught.value.key.replace("[", ".").replace("]", "")
        assert named == key


# ---- what is read


def test_a_robot_comes_back_from_its_own_toml(robot: RobotConfig, tmp_path: Path) -> None:
    assert robot.gain_schedule is not None
    path = tmp_path / "again.toml"
    path.write_text(config_file.to_toml(robot), encoding="utf-8")
    assert config_file.load(path).gain_schedule is None
    shutil.copy(ROBOT_FILE.with_name("robot.gains.json"), tmp_path / "again.gains.json")
    assert config_file.load(path) == robot


def test_text_is_read_as_a_file_is_without_a_schedule(robot: RobotConfig) -> None:
    parsed = config_file.parse(TEXT, "robot.toml of a log")
    assert parsed == msgspec.structs.replace(robot, gain_schedule=None)
    with pytest.raises(ConfigError, match=r"robot\.toml of a log"):
        config_file.parse("name = 3", "robot.toml of a log")


def test_masses_add_up_to_table_i(robot: RobotConfig) -> None:
    assert (robot.torso_mass, robot.total_mass) == pytest.approx((39.66, 74.58))


def test_joint_limits_stand_in_joint_order(robot: RobotConfig) -> None:
    rows = robot.joint_limits()
    assert len(rows) == 12
    assert rows[:6] == rows[6:]
    assert rows[2:4] == (robot.limits.knee.phi, robot.limits.knee.theta)
