"""The recorder as a process on a real bus."""

from __future__ import annotations

import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shared import topics
from shared.bus import Publisher, open_session
from shared.config import load
from shared.exceptions import RunError
from shared.messages import JointState
from shared.process import DEFAULT_CONFIG
from tests.recorder import runs
from tools.runs.run_log import RunLog, read_run

pytestmark = pytest.mark.system

CONFIG = load(DEFAULT_CONFIG)
KEY = topics.JOINT_STATE.key(CONFIG.name, "knee_right")
DEADLINE_S = 20.0


class Rig:
    """A recorder under test and a publisher that it hears."""

    def __init__(self, process: subprocess.Popen[str], out: Path, put: Publisher[JointState]):
        self.process = process
        self.path = out / "run.mcap"
        self.sent = 0
        self._publisher = put

    def send(self, count: int) -> None:
        """Send in small bursts: a full queue drops, and that is not what is tested here."""
        for _ in range(count):
            assert self._publisher.put(runs.state(self.sent))
            self.sent += 1
            if self.sent % 20 == 0:
                time.sleep(0.005)

    def read(self) -> RunLog | None:
        try:
            return read_run(self.path)
        except RunError:
            return None

    def stop(self, with_signal: signal.Signals) -> str:
        """Signal the recorder, wait for its end and return what it said."""
        self.process.send_signal(with_signal)
        return self.process.communicate(timeout=DEADLINE_S)[1]


def wait_for(what: Callable[[], bool], doing: Callable[[], None] = lambda: None) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not what():
        assert time.monotonic() < deadline
        doing()
        time.sleep(0.02)


@pytest.fixture
def rig() -> Iterator[Rig]:
    run_dir = Path(tempfile.mkdtemp(dir="/tmp", prefix="xrl-rec-"))
    model = run_dir / "model.xml"
    model.write_text("<mujoco/>")
    command = [sys.executable, "-m", "services.recorder", "--run-dir", str(run_dir)]
    command += ["--out", str(run_dir / "out"), "--attach", f"model.xml={model}"]
    command += ["--scenario-text", "a test"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        with open_session(CONFIG, "planner", run_dir) as session:
            publisher = session.publisher(topics.JOINT_STATE, JointState, "knee_right")
            rig = Rig(process, run_dir / "out", publisher)

            def heard() -> bool:
                log = rig.read()
                return log is not None and log.count(KEY) > 0

            wait_for(heard, doing=lambda: rig.send(1))
            yield rig
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        if process.stderr:
            process.stderr.close()
        shutil.rmtree(run_dir, ignore_errors=True)


def test_sigterm_writes_what_is_queued_and_finishes_the_file(rig: Rig) -> None:
    rig.send(2000)
    said = rig.stop(signal.SIGTERM)
    assert rig.process.returncode == 0, said
    log = read_run(rig.path)
    messages = log.messages(topics.JOINT_STATE, "knee_right")
    assert log.complete
    assert len(messages) >= 2000
    assert messages[-1].seq == rig.sent - 1
    assert log.gaps()[KEY].missing == 0
    assert KEY in log.metadata["counts"]
    assert log.metadata["run"]["scenario"] == "a test"
    assert log.attachments["model.xml"] == b"<mujoco/>"
    assert log.attachments["robot.toml"] == DEFAULT_CONFIG.read_bytes()


def test_sigkill_loses_nothing_that_was_flushed(rig: Rig) -> None:
    rig.send(1000)
    target = rig.sent

    def flushed() -> bool:
        log = rig.read()
        return log is not None and log.messages(topics.JOINT_STATE, "knee_right")[-1].seq + 1 >= (
            target
        )

    wait_for(flushed)
    rig.send(100)
    rig.stop(signal.SIGKILL)
    log = read_run(rig.path)
    messages = log.messages(topics.JOINT_STATE, "knee_right")
    assert not log.complete
    assert messages[-1].seq >= target - 1
    assert log.gaps()[KEY].missing == 0


def test_a_write_error_ends_with_exit_code_1_and_one_line(rig: Rig) -> None:
    before = rig.path.stat().st_size
    limit = before + 3000
    resource.prlimit(rig.process.pid, resource.RLIMIT_FSIZE, (limit, limit))
    wait_for(lambda: rig.process.poll() is not None, doing=lambda: rig.send(200))
    assert rig.process.stderr
    said = rig.process.stderr.read()
    assert rig.process.returncode == 1
    assert "Traceback" not in said
    assert "Exception ignored" not in said
    (error,) = [line for line in said.splitlines() if "ERROR" in line]
    assert "run.mcap: cannot be written: File too large" in error
    log = read_run(rig.path)
    assert not log.complete
    assert log.count(KEY) > 0


def test_a_file_that_cannot_be_attached_is_refused_before_anything_starts(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "services.recorder", "--run-dir", str(tmp_path / "r")]
    command += ["--out", str(tmp_path / "out"), "--attach", f"a={tmp_path / 'absent'}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "absent: (file): cannot be read" in done.stderr
    assert not (tmp_path / "out").exists()
