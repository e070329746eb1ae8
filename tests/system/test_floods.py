"""Somebody floods the bus of a live fleet: it stands, and a killed planner leads again meanwhile.

Under `mtls`, with ports that others reach. Outcomes only; the times are printed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from shared.bus.messages import Mode
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.places import CHECKOUT, DEFAULT_CONFIG
from tests.certified import certified
from tests.system.fleets import FleetEar, heard, started
from tools.fleet.supervise import SupervisedFleet

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]

BEFORE_KILL_S = 1.0
LEADS_AGAIN_S = 40.0
RECORDER_MAX = 500 << 20


class Flooded(NamedTuple):
    """A live fleet, and an ear on its bus."""

    up: SupervisedFleet
    config: Path
    ear: FleetEar

    def recorder_bytes(self) -> int:
        pid = self.up.pids()["recorder"]
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) << 10
        raise AssertionError(pid)


@pytest.fixture(scope="module")
def fleet(robot: RobotConfig) -> Iterator[Flooded]:
    with tempfile.TemporaryDirectory(prefix="xrl-t-", dir="/tmp") as name:
        folder = Path(name)
        config, run_dir = folder / "robot.toml", folder / "run"
        own = certified(robot, folder, allow=("127.0.0.1",))[0]
        config.write_text(config_file.to_toml(own), encoding="utf-8")
        shutil.copy(DEFAULT_CONFIG.with_suffix(".gains.json"), folder / "robot.gains.json")
        overrides = {"recorder": ["--out", str(folder / "out")]}
        with started(run_dir, config=config, overrides=overrides) as up, heard(own, run_dir) as ear:
            yield Flooded(up, config, ear)


@pytest.mark.parametrize("kind", ["messages", "held", "rubbish"])
def test_it_stands_and_its_planner_leads_again_while_somebody_floods_the_bus(
    fleet: Flooded, kind: str
) -> None:
    ear = fleet.ear
    ear.wait_for(Mode.TRACK, 60.0)
    words = [sys.executable, "-m", "tests.system.flooder", kind]
    words += [str(fleet.config), str(fleet.up.run.path)]
    with subprocess.Popen(words, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as flooder:
        try:
            assert flooder.stdout is not None
            assert flooder.stdout.readline() == "flooding\n"
            ear.world(after_s=BEFORE_KILL_S)
            before = ear.modes()
            fleet.up.kill("planner")
            held_s = ear.wait_for(Mode.HOLD, 10.0)
            again_s = ear.wait_for(Mode.TRACK, LEADS_AGAIN_S)
            assert flooder.poll() is None, "the flood went on until here"
        finally:
            flooder.kill()
    assert not ear.fell
    grown = fleet.recorder_bytes()
    tracked = sum(mode == Mode.TRACK for mode in before.values())
    sys.stdout.write(
        f"{kind}: {tracked} of 6 tracked; held after {held_s:.2f} s, led after {again_s:.2f} s; "
        f"recorder {grown >> 20} MiB\n"
    )
    assert grown < RECORDER_MAX
