"""`xrl hosts` with a live fleet: three hosts of one machine, by a stand-in for ssh and systemd."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import tomli_w

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.process import DEFAULT_CONFIG
from shared.robot.joints import MODULES
from tests.certified import install_all
from tests.system.test_hosts import with_drives_in
from tests.system.waiting import wait_for
from tests.tools.hosts.places import make_hosts
from tools import cli
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet
from tools.keys.authority import Authority

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]

NAMES = ("body", "right", "left")


class Place(NamedTuple):
    """Three hosts and the simulator that stands for the robot."""

    base: Path

    def xrl(self, order: str, *words: str) -> int:
        where = [
            "--hosts",
            str(self.base / "hosts.toml"),
            "--config",
            str(self.base / "robot.toml"),
        ]
        return cli.main(["hosts", order, *words, *where, "--authority", str(self.base / "auth")])

    def run_dir(self, host: str) -> Path:
        return self.base / host / "run/xrl"

    def boot(self, host: str) -> None:
        """Do what systemd does at a host's start: nobody asked for it."""
        words = [str(self.base / "bin/ssh"), host, "systemctl start xrl.service"]
        assert subprocess.run(words, capture_output=True, check=False).returncode == 0

    def modules(self, capsys: Any) -> dict[str, dict[str, Any]]:
        capsys.readouterr()
        run_dir = str(self.run_dir("body"))
        assert cli.main(["status", "--json", "--run-dir", run_dir]) == 0
        found: dict[str, dict[str, Any]] = json.loads(capsys.readouterr().out)["modules"]
        return found


@pytest.fixture
def place(robot: RobotConfig) -> Iterator[Place]:
    base = Path(tempfile.mkdtemp(prefix="xrl-h-", dir="/tmp"))
    file = make_hosts(base, real=True)
    table = tomllib.loads(file.read_text(encoding="utf-8"))
    table["folder"] = str(base / "etc")  # files name it, and so it is one for all
    file.write_text(tomli_w.dumps(table), encoding="utf-8")
    own = with_drives_in(robot, base / "sim")
    (base / "robot.toml").write_text(config_file.to_toml(own), encoding="utf-8")
    shutil.copy(DEFAULT_CONFIG.with_suffix(".gains.json"), base / "robot.gains.json")
    place = Place(base)
    yield place
    for host in NAMES:
        SupervisedFleet(place.run_dir(host)).stop()
    SupervisedFleet(base / "sim").stop()
    shutil.rmtree(base)


def test_hosts_come_up_take_over_after_a_power_cut_and_arm_only_when_asked(
    place: Place, capsys: Any
) -> None:
    assert place.xrl("keys") == 0
    assert [place.xrl("update", host) for host in NAMES] == [0, 0, 0], "they share a folder here"
    keys = place.base / "etc/keys"
    install_all(Authority(place.base / "auth"), keys, "simulator")
    assert place.xrl("check") == 0, capsys.readouterr().out

    SupervisedFleet.start(
        place.base / "etc/robot.toml", place.base / "sim", services=("simulator",)
    )
    for host in NAMES:
        place.boot(host)
    assert wait_for(lambda: {row["drive"] for row in place.modules(capsys).values()} == {"IDLE"}), (
        "nobody has asked for the drives"
    )
    assert {row["mode"] for row in place.modules(capsys).values()} <= {"DISARMED", "FAULT"}

    assert place.xrl("up") == 0

    def modes() -> set[str]:
        return {row["mode"] for row in place.modules(capsys).values()}

    assert wait_for(lambda: modes() == {"TRACK"}, timeout_s=60.0), modes()
    capsys.readouterr()
    assert place.xrl("status") == 0
    said = capsys.readouterr().out
    assert "body: planner" in said
    assert "left: knee_left" in said
    assert all(f"\n  {module} " in said for module in MODULES)

    for pid in procfs.fleet_pids(place.run_dir("left")):
        os.kill(pid, signal.SIGKILL)
    place.boot("left")
    taken = wait_for(lambda: modes() == {"TRACK"}, timeout_s=60.0)
    assert taken, place.modules(capsys)
    assert place.xrl("down") == 0
    assert [procfs.fleet_pids(place.run_dir(host)) for host in NAMES] == [set(), set(), set()]
