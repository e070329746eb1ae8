"""The process table and the checks before a start; no process is started here."""

from __future__ import annotations

import re
import socket
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from shared.config.files import load
from shared.config.robot_config import SERVICES
from shared.exceptions import ConfigError, FleetError, MissingPackageError
from shared.joints import MODULES
from shared.links import PAIRS
from shared.places import DEFAULT_CONFIG
from tools.fleet import process_table
from tools.fleet.run_dir import RunDir, supervisor_config


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as path:
        yield Path(path)


def plan(run_dir: Path, **changes: object) -> process_table.FleetPlan:
    arguments = {
        "overrides": {},
        "services": None,
        "simulation": True,
        "table_path": process_table.TABLE,
        **changes,
    }
    return process_table.make_plan(DEFAULT_CONFIG, run_dir, **arguments)


def test_the_table_has_one_row_for_each_service_of_the_bus() -> None:
    beside = ("injected", "ros2", "named")
    names = [row.name for row in process_table.load_table().process if row.only not in beside]
    assert sorted(names) == sorted(SERVICES)


def test_the_injector_stands_between_those_that_dial_only_where_it_is_asked_for(
    run_dir: Path,
) -> None:
    plain, injected = plan(run_dir), plan(run_dir, injected=True)
    assert "network_proxy" not in plain.commands
    assert [name for name, words in plain.commands.items() if "--injected" in words] == []
    dialling = {name for name, words in injected.commands.items() if "--injected" in words}
    assert dialling == {"planner", "harness"}, "no IMU is fitted"
    new = {item.endpoint for item in injected.listeners} - {i.endpoint for i in plain.listeners}
    assert len(new) == len(PAIRS) + 1, "a socket for each pair, and its own"
    names = [row.name for row in injected.processes]
    assert names.index("network_proxy") < names.index("planner")


def test_a_hosts_own_recorder_is_there_only_where_it_is_named(run_dir: Path) -> None:
    assert "host_recorder" not in plan(run_dir).commands
    assert "host_recorder" not in plan(run_dir, services=("knee_left",)).commands
    own = plan(run_dir, services=("knee_left", "host_recorder"))
    assert "host_recorder" in own.commands
    assert [item.service for item in own.listeners] == ["knee_left"], "it listens nowhere"


def test_the_gateway_to_ros_2_is_there_only_where_it_is_asked_for(run_dir: Path) -> None:
    assert "ros2_gateway" not in plan(run_dir).commands
    words = plan(run_dir, ros2=True, overrides={"ros2_gateway": ["--domain", "7"]}).commands
    assert words["ros2_gateway"][-2:] == ["--domain", "7"]


def test_joint_commands_name_their_module_and_no_placeholder_is_left(run_dir: Path) -> None:
    commands = plan(run_dir).commands
    for module in MODULES:
        assert module in commands[module]
    assert not [word for words in commands.values() for word in words if "{" in word]


def test_overrides_come_after_the_command(run_dir: Path) -> None:
    commands = plan(run_dir, overrides={"recorder": ["--out", "x"]}).commands
    assert commands["recorder"][-2:] == ["--out", "x"]


def test_the_simulator_is_not_started_for_a_real_robot(run_dir: Path) -> None:
    assert "simulator" in plan(run_dir).commands
    assert "simulator" not in plan(run_dir, simulation=False).commands


def test_drives_on_socketcan_are_no_simulation(tmp_path: Path) -> None:
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    real = tmp_path / "real.toml"
    real.write_text(text.replace('"xrl_unix"', '"socketcan"'), encoding="utf-8")
    assert process_table.is_simulated(load(DEFAULT_CONFIG))
    assert not process_table.is_simulated(load(real))


def test_a_bus_of_an_imu_that_is_not_fitted_makes_no_simulation(tmp_path: Path) -> None:
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    real, emulated = tmp_path / "real.toml", '[can.imu]\ninterface = "xrl_unix"'
    others = text.replace(emulated, "(imu)").replace('"xrl_unix"', '"socketcan"')
    real.write_text(others.replace("(imu)", emulated), encoding="utf-8")
    assert not process_table.is_simulated(load(real))


def test_the_imus_service_is_started_on_a_robot_that_has_one_and_by_the_injectors_way(
    run_dir: Path, tmp_path: Path
) -> None:
    fitted = tmp_path / "robot.toml"
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    fitted.write_text(text.replace("fitted = false", "fitted = true"), encoding="utf-8")
    assert "imu" not in plan(run_dir).commands
    told = process_table.make_plan(
        fitted,
        run_dir,
        overrides={},
        services=None,
        simulation=True,
        injected=True,
        table_path=process_table.TABLE,
    )
    assert "--injected" in told.commands["imu"]
    assert set(load(fitted).services) <= set(told.commands)


def test_drives_on_usb_are_not_looked_for_without_their_package(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "odrive", None)
    assert "knee_left" in plan(run_dir).commands
    on_usb = run_dir / "robot.toml"
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    on_usb.write_text(text.replace('driver = "odrive_can"', 'driver = "odrive_usb"'), "utf-8")
    make = partial(
        process_table.make_plan,
        on_usb,
        run_dir,
        overrides={},
        simulation=False,
        table_path=process_table.TABLE,
    )
    assert list(make(services=["planner"]).commands) == ["planner"]
    with pytest.raises(MissingPackageError, match="the extra `usb` brings it"):
        make(services=None)


@pytest.mark.parametrize("changes", [{"services": ["plannr"]}, {"overrides": {"plannr": []}}])
def test_an_unknown_service_is_refused_with_the_known_ones(
    run_dir: Path, changes: dict[str, object]
) -> None:
    with pytest.raises(FleetError, match=r"'plannr'.*planner"):
        plan(run_dir, **changes)


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("stop_s = 900", "process[0].stop_s"),
        ('colour = "red"', "process[0].colour"),
        ('topic = "joint/state"', "process[0].topic"),
        ('only = "sundays"', "process[0].only"),
        ('extra = "sundays"', "process[0].extra"),
    ],
)
def test_a_bad_row_is_refused_with_its_key(tmp_path: Path, line: str, key: str) -> None:
    good = {
        "name": '"a"', "kind": '"planner"', "command": '["true"]', "autostart": "true",
        "ready": '"running"', "stop_signal": '"TERM"', "stop_s": "1", "settle_s": "1",
        "why": '"a test"',
    }  # fmt: skip
    name, _, value = line.partition(" = ")
    rows = "\n".join(f"{k} = {v}" for k, v in {**good, name: value}.items())
    table = tmp_path / "processes.toml"
    table.write_text(f"[environment]\n[[process]]\n{rows}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as refusal:
        process_table.load_table(table)
    assert refusal.value.key == key


@pytest.mark.parametrize(
    ("word", "becomes", "key", "told"),
    [
        ('"{run}"', '"{Run}"', "command", "{Run} is no placeholder here; one of {python}"),
        ('"{run}"', '"{module}"', "command", "{module} is no placeholder here"),
        ('name = "simulator"', 'name = "{simulator}"', "name", "one of {module}"),
    ],
)
def test_a_placeholder_that_the_table_does_not_know_is_refused(
    tmp_path: Path, word: str, becomes: str, key: str, told: str
) -> None:
    text = process_table.TABLE.read_text(encoding="utf-8")
    table = tmp_path / "processes.toml"
    table.write_text(text.replace(word, becomes, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=re.escape(f"process[0].{key}")) as refusal:
        process_table.load_table(table)
    assert told in str(refusal.value)


def test_a_service_that_stands_twice_is_refused(tmp_path: Path) -> None:
    text = process_table.TABLE.read_text(encoding="utf-8").replace(
        'name = "harness"', 'name = "knee_left"'
    )
    table = tmp_path / "processes.toml"
    table.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="'knee_left' stands twice"):
        process_table.load_table(table)


def test_a_run_directory_too_long_for_sockets_is_refused() -> None:
    with pytest.raises(FleetError, match=r"too long by \d+ bytes"):
        plan(Path("/tmp") / ("long" * 25))


def test_a_bound_port_is_refused_with_service_and_endpoint() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(FleetError, match=f"planner: {endpoint}: port in use"):
            process_table.check_free(
                [process_table.ListenPoint("planner", "bus.endpoints.planner", endpoint)]
            )
    process_table.check_free(
        [process_table.ListenPoint("planner", "bus.endpoints.planner", endpoint)]
    )


def test_a_unix_socket_is_in_use_only_while_it_is_listened_to(run_dir: Path) -> None:
    path = run_dir / "planner.zenoh"
    listener = process_table.ListenPoint(
        "planner", "bus.endpoints.planner", f"{process_table.UNIX}{path}"
    )
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(FleetError, match=f"{path}: in use"):
            process_table.check_free([listener])
    assert path.exists()
    process_table.check_free([listener])


def test_a_percent_sign_in_a_path_reaches_supervisord_unharmed(run_dir: Path) -> None:
    odd = process_table.make_plan(
        DEFAULT_CONFIG,
        run_dir,
        overrides={"recorder": ["--out", "50 % off"]},
        services=["recorder"],
        simulation=True,
        table_path=process_table.TABLE,
    )
    text = supervisor_config(RunDir(run_dir), odd, no_restart=frozenset({"recorder"}))
    assert "'50 %% off'" in text
    assert "autorestart=false" in text


def test_the_service_of_an_imu_that_is_not_fitted_is_refused(run_dir: Path) -> None:
    with pytest.raises(FleetError, match="imu: this robot has none"):
        plan(run_dir, services=["imu"])
