"""A robot whose services run on several hosts: `xrl up --only` on each.

Three run directories stand for the hosts; they share the bus over TLS, each with the keys of its
own services only, and, as they are one machine after all, the emulated drives.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.bus.topics import OPERATOR, VIEWER
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tests.certified import certified, install_all
from tests.system.fleets import wait_for
from tools import cli
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet
from tools.keys.authority import Authority

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

BODY = ("simulator", "harness", "recorder", "planner")
HOSTS = {
    "body": BODY,
    "right": tuple(module for module in MODULES if module.endswith("_right")),
    "left": tuple(module for module in MODULES if module.endswith("_left")),
}


@pytest.fixture
def run_dirs() -> Iterator[dict[str, Path]]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as parent:
        paths = {host: Path(parent) / host for host in HOSTS}
        yield paths
        for path in paths.values():
            SupervisedFleet(path).stop()


def with_drives_in(robot: RobotConfig, drives: Path) -> RobotConfig:
    """Return the robot with its drives in one place."""
    can = {
        name: msgspec.structs.replace(bus, channel=bus.channel.replace("{run}", str(drives)))
        for name, bus in robot.can.items()
    }
    return msgspec.structs.replace(robot, can=can)


def robot_file(robot: RobotConfig, made: Authority, folder: Path, names: tuple[str, ...]) -> Path:
    """Write the robot file of one host, which has the keys of these names only."""
    install_all(made, folder / "keys", *names)
    security = msgspec.structs.replace(robot.bus.security, keys=str(folder / "keys"))
    bus = msgspec.structs.replace(robot.bus, security=security)
    path = folder / "robot.toml"
    own = msgspec.structs.replace(robot, bus=bus)
    path.write_text(config_file.to_toml(own), encoding="utf-8")
    schedule = DEFAULT_CONFIG.with_suffix(".gains.json")
    (folder / "robot.gains.json").write_bytes(schedule.read_bytes())
    return path


def test_each_host_starts_its_own_services_and_all_six_modules_track(
    robot: RobotConfig, run_dirs: dict[str, Path], tmp_path: Path, capsys: Any
) -> None:
    everywhere, made = certified(with_drives_in(robot, run_dirs["body"]), tmp_path / "authority")
    for host, services in HOSTS.items():
        tools = (OPERATOR,) if host == "body" else (VIEWER,)
        path = robot_file(everywhere, made, tmp_path / f"keys-{host}", (*services, *tools))
        where = ["--config", str(path), "--run-dir", str(run_dirs[host])]
        assert (
            cli.main(["up", *where, "--out", str(tmp_path / host), "--only", ",".join(services)])
            == 0
        )
        assert set(SupervisedFleet.attach(run_dirs[host]).pids()) == set(services)
    assert (tmp_path / "body" / "run.mcap").exists()
    assert not (tmp_path / "right").exists(), "a host without recorder records nothing"

    def modes() -> set[str]:
        capsys.readouterr()
        assert cli.main(["status", "--json", "--run-dir", str(run_dirs["left"])]) == 0
        status = json.loads(capsys.readouterr().out)
        assert set(status["services"]) == set(HOSTS["left"])
        return {module["mode"] for module in status["modules"].values()}

    assert wait_for(lambda: modes() == {"TRACK"}, timeout_s=60.0), (
        "each host hears the modules of all"
    )
    for run_dir in run_dirs.values():
        assert cli.main(["down", "--run-dir", str(run_dir)]) == 0
        assert procfs.fleet_pids(run_dir) == set()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "knee"], "no service 'knee'; one of simulator, ankle_right"),
        (["--only", " , "], "--only names no service"),
        (["--only", "planner", "--scenario", "squat"], "--only starts none"),
        (["--only", "planner", "--snapshot", "5"], "--snapshot is for the recorder"),
        (["--only", "recorder", "--injectable"], "--injectable is for the planner"),
        (["--no-sim", "--scenario", "squat"], "--no-sim starts none"),
    ],
)
def test_what_does_not_go_together_is_refused_and_nothing_is_started(
    arguments: list[str], words: str, run_dirs: dict[str, Path], capsys: Any
) -> None:
    assert cli.main(["up", "--run-dir", str(run_dirs["body"]), *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not run_dirs["body"].exists()
