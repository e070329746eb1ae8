"""A fleet that leads: asked by a script, led by keys, in this order."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.bus.messages import Mode
from shared.clock import keep_pace
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from shared.run_directory import RUN_DIR_VARIABLE
from tests.system.fleets import heard, wait_for, xrl

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]

ROOT = DEFAULT_CONFIG.parents[1]
SCRIPT = ROOT / "examples" / "send_intent.py"


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    """Return the run directory of a fleet that leads."""
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as path:
        run_dir = Path(path) / "r"
        up = xrl("up", "--out", Path(path) / "run", run_dir=run_dir)
        assert up.returncode == 0, up.stderr
        try:
            keep_pace(run_dir)
            yield run_dir
        finally:
            keep_pace(Path(path))
            down = xrl("down", run_dir=run_dir)
        assert down.returncode == 0, down.stderr


@pytest.fixture
def leading(place: Path, robot: RobotConfig) -> Path:
    """Return the run directory once the planner leads."""
    with heard(robot, place) as ear:
        ear.wait_until_led()
    return place


def test_the_planner_gives_the_assist_that_a_script_asks_for(leading: Path) -> None:
    done = subprocess.run(
        [sys.executable, SCRIPT],
        env=os.environ | {RUN_DIR_VARIABLE: str(leading)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    words = done.stdout.split()
    assert words[:3] == ["the", "planner", "gives"]
    assert float(words[3]) > 20.0, done.stdout


class Typist:
    """Types into `xrl lead --keys` on a terminal of its own."""

    def __init__(self, place: Path) -> None:
        self.shown = b""
        self._pid, self._descriptor = pty.fork()
        if self._pid == 0:
            words = [sys.executable, "-m", "tools.cli", "lead", "--keys", "--run-dir", str(place)]
            os.execv(sys.executable, words)  # noqa: S606 - a command of ours, no shell

    def types(self, key: bytes) -> None:
        os.write(self._descriptor, key)

    def shows(self, text: bytes) -> bool:
        if select.select([self._descriptor], [], [], 0.0)[0]:
            with contextlib.suppress(OSError):  # it has ended
                self.shown += os.read(self._descriptor, 1 << 16)
        return text in self.shown

    def ends(self) -> int:
        status = []
        assert wait_for(lambda: bool(self.shows(b"\0") or status.extend(self._reaped()) or status))
        os.close(self._descriptor)
        return status[0]

    def _reaped(self) -> list[int]:
        pid, status = os.waitpid(self._pid, os.WNOHANG)
        return [os.waitstatus_to_exitcode(status)] if pid else []


def test_a_person_leads_the_robot_down_by_keys_lets_go_and_stops_it(
    leading: Path, robot: RobotConfig
) -> None:
    with heard(robot, leading) as ear:
        before = ear.world().torso[2]
        person = Typist(leading)
        assert wait_for(lambda: person.shows(b"arrows"))

        def goes_down() -> bool:
            person.types(b"\x1b[B")  # as a key that is held
            ear.listen()
            return ear.world().torso[2] < before - 0.08

        assert wait_for(goes_down), person.shown[-300:]
        person.types(b"q")
        assert person.ends() == 0
        person = Typist(leading)
        assert wait_for(lambda: person.shows(b"arrows"))
        person.types(b" ")
        assert person.ends() == 0
        ear.listen()
        assert {state.mode for state in ear.states.values()} == {Mode.DAMP}
        assert len(ear.states) == len(MODULES)
