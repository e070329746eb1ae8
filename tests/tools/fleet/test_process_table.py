"""The process table and the checks before a start; no process is started here."""

from __future__ import annotations

import re
import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from shared import run_directory
from shared.config.files import load
from shared.config.robot_config import SERVICES
from shared.exceptions import ConfigError, FleetError, MissingPackageError
from shared.joints import MODULES
from shared.links import PAIRS
from tests.tools.fleet.plans import plan, robot_file, table_file
from tools.fleet.process_table import UNIX, ListenPoint, check_free, is_simulated, load_table
from tools.fleet.run_dir import RunDir, one_line, supervisor_config

REAL = ('"xrl_unix"', '"socketcan"')
FITTED = ("fitted = false", "fitted = true")


def test_the_table_has_one_row_for_each_service_of_the_bus() -> None:
    beside = ("injected", "ros2", "named")
    names = [row.name for row in load_table().process if row.only not in beside]
    assert sorted(names) == sorted(SERVICES)


@pytest.mark.parametrize(
    ("service", "without", "asked"),
    [
        ("simulator", {"simulation": False}, {}),
        ("network_proxy", {}, {"injected": True}),
        ("ros2_gateway", {}, {"ros2": True}),
        ("host_recorder", {"services": ("knee_left",)}, {"services": ("host_recorder",)}),
    ],
)
def test_a_service_is_there_only_where_it_is_asked_for(
    run_dir: Path, service: str, without: dict[str, Any], asked: dict[str, Any]
) -> None:
    assert service not in plan(run_dir, **without).commands
    overridden = plan(run_dir, **asked, overrides={service: ["--word", "x"]})
    if service == "host_recorder":
        assert overridden.listeners == (), "it listens nowhere"
    assert overridden.commands[service][-2:] == ["--word", "x"], "behind the table's own words"


def test_the_injector_stands_between_those_that_dial(run_dir: Path, tmp_path: Path) -> None:
    plain, injected = plan(run_dir), plan(run_dir, injected=True)
    assert [name for name, words in plain.commands.items() if "--injected" in words] == []
    dialling = {name for name, words in injected.commands.items() if "--injected" in words}
    assert dialling == {"planner", "harness"}, "no IMU is fitted"
    new = {item.endpoint for item in injected.listeners} - {i.endpoint for i in plain.listeners}
    assert len(new) == len(PAIRS) + 1, "a socket for each pair, and its own"
    names = [row.name for row in injected.processes]
    assert names.index("network_proxy") < names.index("planner")
    fitted = robot_file(tmp_path, FITTED)
    assert "imu" not in plain.commands
    with_imu = plan(run_dir, fitted, injected=True).commands
    assert "--injected" in with_imu["imu"]
    assert set(load(fitted).services) <= set(with_imu)


def test_joint_commands_name_their_module_and_no_placeholder_is_left(run_dir: Path) -> None:
    commands = plan(run_dir).commands
    for module in MODULES:
        assert module in commands[module]
    assert not [word for words in commands.values() for word in words if "{" in word]


def test_drives_on_socketcan_are_no_simulation(tmp_path: Path) -> None:
    """Nor is a bus of an IMU that is not fitted."""
    emulated = '[can.imu]\ninterface = "xrl_unix"'
    but_imu = ((emulated, "(imu)"), REAL, ("(imu)", emulated))
    assert is_simulated(load(robot_file(tmp_path)))
    assert not is_simulated(load(robot_file(tmp_path, REAL)))
    assert not is_simulated(load(robot_file(tmp_path, *but_imu)))


def test_no_fleet_is_started_on_buses_of_which_one_is_emulated_and_another_real(
    run_dir: Path, tmp_path: Path
) -> None:
    """Its simulator would stand beside real drives."""
    one = "[can.harness]\ninterface = "
    half = robot_file(tmp_path, REAL, (one + REAL[1], one + REAL[0]))
    with pytest.raises(FleetError, match=r"\[can\.harness\] is emulated"):
        plan(run_dir, half)
    assert "knee_left" in plan(run_dir, half, simulation=False).commands


def test_drives_on_usb_are_not_looked_for_without_their_package(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "odrive", None)
    assert "knee_left" in plan(run_dir).commands
    on_usb = robot_file(tmp_path, ('driver = "odrive_can"', 'driver = "odrive_usb"'))
    real = {"simulation": False}
    assert list(plan(run_dir, on_usb, services=["planner"], **real).commands) == ["planner"]
    with pytest.raises(MissingPackageError, match="the extra `usb` includes it"):
        plan(run_dir, on_usb, **real)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"services": ["plannr"]}, r"'plannr'.*planner"),
        ({"overrides": {"plannr": []}}, r"'plannr'.*planner"),
        ({"not_started": ["plannr"]}, r"'plannr'.*planner"),
        ({"services": ["imu"]}, "imu: this robot has no IMU"),
        ({"services": ["ros2_gateway"]}, "it starts only with --ros2"),
    ],
)
def test_a_service_that_this_fleet_does_not_have_is_refused(
    run_dir: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(FleetError, match=words):
        plan(run_dir, **options)


@pytest.mark.parametrize(
    ("was", "becomes", "key", "told"),
    [
        ("stop_s = 3", "stop_s = 900", "process[0].stop_s", "1 to 60"),
        ('name = "simulator"', 'name = "simulator"\ncolour = "red"', "process[0].colour", "colour"),
        ('extra = "sim"', 'extra = "sundays"', "process[0].extra", "one of "),
        ('topic = "sim/truth"', 'topic = "joint/state"', "process[0].topic", "one of "),
        ('only = "simulation"', 'only = "sundays"', "process[0].only", "sundays"),
        (
            '"{run}"',
            '"{Run}"',
            "process[0].command",
            "{Run} is not a placeholder here; must be one of {py",
        ),
        ('"{run}"', '"{module}"', "process[0].command", "{module} is not a placeholder here"),
        ('name = "simulator"', 'name = "{simulator}"', "process[0].name", "one of {module}"),
        ('name = "harness"', 'name = "knee_left"', "process", "'knee_left' is listed twice"),
    ],
)
def test_a_bad_row_is_refused_with_its_key(
    tmp_path: Path, was: str, becomes: str, key: str, told: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(told)) as refusal:
        load_table(table_file(tmp_path, (was, becomes)))
    assert refusal.value.key == key


def test_a_run_directory_too_long_for_sockets_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    plan(Path("/tmp") / ("long" * 25))  # its sockets lie elsewhere, in memory
    monkeypatch.setattr(run_directory, "_MEMORY_FOLDERS", ())
    with pytest.raises(FleetError, match=r"\d+ B too long"):
        plan(Path("/tmp") / ("long" * 25))


@pytest.mark.parametrize("family", ["tcp", "unix"])
def test_an_endpoint_is_in_use_only_while_somebody_listens_on_it(
    tmp_path: Path, family: str
) -> None:
    with socket.socket(socket.AF_UNIX if family == "unix" else socket.AF_INET) as other:
        if family == "unix":
            other.bind(str(tmp_path / "x"))
            other.listen()
            endpoint, told = f"{UNIX}{tmp_path / 'x'}", "in use"
        else:
            other.bind(("127.0.0.1", 0))
            endpoint, told = f"tcp/127.0.0.1:{other.getsockname()[1]}", "port in use"
        points = [ListenPoint("planner", "bus.endpoints.planner", endpoint)]
        with pytest.raises(FleetError, match=f"planner: {endpoint}: {told}"):
            check_free(points)
    check_free(points)


def test_an_argument_with_special_characters_is_quoted_for_its_program(run_dir: Path) -> None:
    options = {"services": ["recorder"], "no_restart": ["recorder"]}
    odd = plan(run_dir, overrides={"recorder": ["--out", "50 % #off"]}, **options)
    text = supervisor_config(RunDir(run_dir), odd)
    assert " --out '50 % #off'\n" in text
    assert "autorestart=false" in text


@pytest.mark.parametrize("text", ["a\nb", "a\rb"])
def test_a_line_break_that_would_begin_another_setting_is_refused(text: str) -> None:
    with pytest.raises(FleetError, match="has a line break; rename it"):
        one_line(text)
