"""`xrl hosts` with a live fleet: three hosts of one machine, by a stand-in for ssh and systemd."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from services.joint.drivers.base import DriveStatus
from shared.bus import topics
from shared.bus.messages import JointState, Mode
from shared.bus.session import Session, open_session
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tests.certified import install_all
from tests.system.test_hosts import with_drives_in
from tests.system.waiting import wait_for
from tests.tools.hosts.places import SHARED, make_hosts
from tools import cli
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet
from tools.keys.authority import Authority
from tools.logs.run_log import read_run

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]

NAMES = ("body", "right", "left")
SILENT_S = 0.3


class Place(NamedTuple):
    """Three hosts and the simulator that stands for the robot."""

    base: Path

    def xrl(self, order: str, *words: str, verb: str = "hosts") -> int:
        files = {"--hosts": "hosts.toml", "--config": "robot.toml", "--authority": "auth"}
        where = [word for flag, name in files.items() for word in (flag, str(self.base / name))]
        return cli.main([verb, order, *words, *where])

    def run_dir(self, host: str) -> Path:
        return self.base / host / "var/lib/xrl/run"

    def boot(self, host: str) -> None:
        """Do what systemd does at a host's start: nobody asked for it."""
        words = [str(self.base / "bin/ssh"), host, "systemctl start xrl.service"]
        assert subprocess.run(words, capture_output=True, check=False).returncode == 0

    def cut_power(self, host: str, watch: Watch) -> None:
        """Kill all that runs on a host, and boot it again; its drives have power of their own."""
        for pid in procfs.fleet_pids(self.run_dir(host)):
            os.kill(pid, signal.SIGKILL)
        watch.wait_for_silence()
        self.boot(host)


class Watch:
    """Hears the six modules by links that stay open."""

    def __init__(self, session: Session) -> None:
        self._latest = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        self._states: dict[str, JointState] = {}
        self._heard_s: dict[str, float] = {}

    def states(self) -> list[JointState | None]:
        """Return each module's state; None of one that is silent."""
        now_s = time.monotonic()
        for module, latest in self._latest.items():
            state = latest.take()
            if state is not None:
                self._states[module], self._heard_s[module] = state, now_s
        return [
            self._states[module] if now_s - self._heard_s.get(module, 0.0) < SILENT_S else None
            for module in MODULES
        ]

    def all_in(self, *modes: Mode) -> bool:
        return all(state is not None and state.mode in modes for state in self.states())

    def wait_for(self, *modes: Mode) -> None:
        assert wait_for(lambda: self.all_in(*modes), timeout_s=60.0), self.states()

    def wait_for_silence(self) -> None:
        assert wait_for(lambda: None in self.states()), "somebody was killed"


@pytest.fixture
def place(robot: RobotConfig) -> Iterator[Place]:
    base = Path(tempfile.mkdtemp(prefix="xrl-h-", dir="/tmp"))
    make_hosts(base, real=True, running=True)
    own = with_drives_in(robot, base / "sim")
    (base / "robot.toml").write_text(config_file.to_toml(own), encoding="utf-8")
    shutil.copy(DEFAULT_CONFIG.with_suffix(".gains.json"), base / "robot.gains.json")
    place = Place(base)
    yield place
    for host in NAMES:
        SupervisedFleet(place.run_dir(host)).stop()
    SupervisedFleet(base / "sim").stop()
    shutil.rmtree(base)


def test_hosts_come_up_take_over_after_a_power_cut_and_stay_stopped_until_somebody_ends_it(
    place: Place, capsys: Any
) -> None:
    assert place.xrl("make", verb="keys") == 0
    assert place.xrl("update") == 0
    assert place.xrl("check") == 0, capsys.readouterr().out
    for host in NAMES:  # each has its own keys, though all files name one folder
        assert (place.base / host / SHARED / "keys/hip_left.key").exists() == (host == "left")

    of_simulator = place.base / SHARED
    install_all(Authority(place.base / "auth"), of_simulator / "keys", "simulator", "operator")
    for name in ("robot.toml", "robot.gains.json"):
        shutil.copy(place.base / "body" / SHARED / name, of_simulator)
    SupervisedFleet.start(of_simulator / "robot.toml", place.base / "sim", services=("simulator",))
    for host in NAMES:
        place.boot(host)
    secured = config_file.load(of_simulator / "robot.toml")
    with open_session(secured, "test", place.base / "sim") as session:
        lead_through(place, Watch(session), capsys)
    assert [procfs.fleet_pids(place.run_dir(host)) for host in NAMES] == [set(), set(), set()]
    assert not list(place.base.rglob("*.rearm")), "the stop is over: a person has asked for that"


def lead_through(place: Place, watch: Watch, capsys: Any) -> None:
    watch.wait_for(Mode.DISARMED, Mode.FAULT)
    drives = {state.drive for state in watch.states() if state is not None}
    assert drives == {DriveStatus.IDLE}, "nobody has asked for them"

    assert place.xrl("up") == 0
    watch.wait_for(Mode.TRACK)
    capsys.readouterr()
    assert place.xrl("status") == 0
    said = capsys.readouterr().out
    assert "body: planner" in said
    assert "left: knee_left" in said
    assert all(f"\n{module} " in said for module in MODULES)
    assert place.xrl("update") == 3
    assert "`xrl hosts down` first" in " ".join(capsys.readouterr().out.split())

    assert place.xrl("records", "-o", str(place.base / "so far")) == 2
    assert "--while-up" in capsys.readouterr().err
    assert place.xrl("records", "--while-up", "-o", str(place.base / "so far")) == 0
    assert read_run(place.base / "so far" / "joined").count(topics.PLANNER_STATUS.key("xrl"))

    before = procfs.fleet_pids(place.run_dir("right"))
    place.cut_power("left", watch)
    watch.wait_for(Mode.TRACK)
    assert place.xrl("up") == 0, "asked for again it restarts nothing"
    assert procfs.fleet_pids(place.run_dir("right")) == before

    assert place.xrl("estop") == 0
    watch.wait_for(Mode.DAMP)
    place.cut_power("left", watch)
    assert wait_for(lambda: None not in watch.states(), timeout_s=60.0)
    assert watch.all_in(Mode.DAMP), "the stop holds on"
    capsys.readouterr()
    assert place.xrl("up") == 3
    said = " ".join(capsys.readouterr().out.split())
    assert "an emergency stop by xrl estop by" in said
    assert watch.all_in(Mode.DAMP)
    assert place.xrl("down") == 0

    out = place.base / "records"
    assert place.xrl("records", "-o", str(out)) == 0
    assert [len(list((out / host).glob("*/run.mcap"))) for host in NAMES] == [1, 1, 3]
    joined = read_run(out / "joined")
    for module in MODULES:
        modes = [event.mode_after for event in joined.messages(topics.JOINT_EVENT, module)]
        assert modes[-1] == Mode.DAMP, "to the end"
        assert Mode.TRACK in modes
