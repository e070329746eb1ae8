"""Somebody floods the bus of a live fleet: it stands, and a killed planner leads again meanwhile.

Outcomes only. The times are printed, and stand in docs/security.md.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from shared.bus import topics
from shared.bus.messages import JointState, Mode, SimTruth
from shared.bus.session import Latest, Session, open_session
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import CHECKOUT, DEFAULT_CONFIG
from tests.certified import certified
from tools.fleet.supervise import SupervisedFleet

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]

BEFORE_KILL_S = 2.0
LEADS_AGAIN_S = 40.0
RECORDER_MAX = 500 << 20


class Fleet(NamedTuple):
    """A live fleet, and an ear on its bus."""

    supervised: SupervisedFleet
    config: Path
    states: dict[str, Latest[JointState]]
    truths: Latest[SimTruth]
    modes: dict[str, int]

    def listen(self) -> None:
        for module, latest in self.states.items():
            state = latest.take()
            if state is not None:
                self.modes[module] = state.mode
        truth = self.truths.take()
        assert truth is None or not truth.fallen, "it fell"

    def wait_for(self, mode: Mode, within_s: float) -> float:
        """Wait until all six are in a mode, and return how long it took."""
        begin = time.monotonic()
        while self.modes != dict.fromkeys(MODULES, mode):
            assert time.monotonic() - begin < within_s, self.modes
            self.listen()
            time.sleep(0.002)
        return time.monotonic() - begin

    def recorder_bytes(self) -> int:
        pid = self.supervised.pids()["recorder"]
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) << 10
        raise AssertionError(pid)


def fleet_of(robot: RobotConfig, session: Session, up: SupervisedFleet, config: Path) -> Fleet:
    states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
    return Fleet(up, config, states, session.latest(topics.SIM_TRUTH, SimTruth), {})


SAMPLE = [
    ("local", "messages"),
    ("local", "held"),
    ("mtls", "garbage"),
    ("mtls", "held"),
    ("mtls", "rubbish"),
]
"""The others of `flooder.KINDS` by hand: what was seen of them stands in docs/security.md."""


@pytest.fixture(scope="module")
def fleet(request: pytest.FixtureRequest, robot: RobotConfig) -> Iterator[Fleet]:
    folder = Path(tempfile.mkdtemp(prefix="xrl-t-", dir="/tmp"))
    config = folder / "robot.toml"
    own = certified(robot, folder, allow=("127.0.0.1",))[0] if request.param == "mtls" else robot
    config.write_text(config_file.to_toml(own), encoding="utf-8")
    shutil.copy(DEFAULT_CONFIG.with_suffix(".gains.json"), folder / "robot.gains.json")
    overrides = {"recorder": ["--out", str(folder / "out")]}
    up = SupervisedFleet.start(config, folder / "run", overrides=overrides)
    try:
        with open_session(own, "test", folder / "run") as session:
            found = fleet_of(own, session, up, config)
            found.wait_for(Mode.TRACK, 60.0)
            yield found
    finally:
        up.stop()
        shutil.rmtree(folder)


@pytest.mark.parametrize(("fleet", "kind"), SAMPLE, indirect=["fleet"], scope="module")
def test_it_stands_and_its_planner_leads_again_while_somebody_floods_the_bus(
    fleet: Fleet, kind: str
) -> None:
    fleet.wait_for(Mode.TRACK, 60.0)
    command = [sys.executable, "-m", "tests.system.flooder", kind]
    command += [str(fleet.config), str(fleet.supervised.run.path)]
    with subprocess.Popen(command, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as flooder:
        try:
            assert flooder.stdout is not None
            assert flooder.stdout.readline() == "flooding\n"
            until = time.monotonic() + BEFORE_KILL_S
            while time.monotonic() < until:
                fleet.listen()
                time.sleep(0.002)
            before = dict(fleet.modes)
            fleet.supervised.kill("planner")
            fleet.modes.clear()
            held_s = fleet.wait_for(Mode.HOLD, 10.0)
            again_s = fleet.wait_for(Mode.TRACK, LEADS_AGAIN_S)
            assert flooder.poll() is None, "the flood went on until here"
        finally:
            flooder.kill()
    grown = fleet.recorder_bytes()
    tracked = sum(mode == Mode.TRACK for mode in before.values())
    sys.stdout.write(
        f"{kind}: {tracked} of 6 tracked; held after {held_s:.2f} s, led after {again_s:.2f} s; "
        f"recorder {grown >> 20} MiB\n"
    )
    assert grown < RECORDER_MAX
