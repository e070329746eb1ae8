"""`xrl log play` on a real bus, as a person types it, with real subscribers."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from shared.bus import codec, topics
from shared.bus.messages import Estop, JointState, Message, Wrench
from shared.bus.session import Session, open_session
from shared.bus.traces import SimTruth
from shared.config import files as config_file
from shared.places import DEFAULT_CONFIG
from tests.messages import sample
from tests.shared.mcap_log import runs
from tools.verbs.log.play import LISTEN

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

ROOT = DEFAULT_CONFIG.parents[1]
ROBOT = config_file.load(DEFAULT_CONFIG)
NAME = ROBOT.name
PATIENCE_S = 30.0
BEGAN = 5_000_000_000
STATE = topics.JOINT_STATE.key(NAME, "knee_left")
WRENCH = topics.WRENCH.key(NAME)
TRUTH = topics.SIM_TRUTH.key(NAME)
STOP = topics.ESTOP.key(NAME)
KINDS: dict[str, type[Message]] = {
    STATE: JointState, WRENCH: Wrench, TRUTH: SimTruth, STOP: Estop,
}  # fmt: skip

Item = tuple[str, bytes, int]


class Ended(NamedTuple):
    code: int
    out: str


def items(seconds: float, *keys: str) -> list[Item]:
    """Return messages of some keys, 100 of each for each second."""
    found: list[Item] = []
    for n in range(round(100 * seconds)):
        for k, key in enumerate(keys or (STATE, WRENCH, TRUTH)):
            t_ns = BEGAN + 10_000_000 * n + 1_000_000 * k
            found.append((key, codec.encode(sample(KINDS[key], seq=n, t_ns=t_ns)), t_ns + 77))
    return found


def write(
    directory: Path, rows: list[Item], monkeypatch: pytest.MonkeyPatch, parts: int = 1
) -> str:
    """Write a run of the shipped robot, in one file or several, and return its directory."""
    monkeypatch.setitem(runs.METADATA, "run", {**runs.METADATA["run"], "robot": NAME})
    monkeypatch.setitem(runs.ATTACHMENTS, "robot.toml", config_file.to_toml(ROBOT).encode())
    runs.write_in_parts(runs.writer(directory, keys=topics.recorded_keys(NAME)), rows, parts)
    return str(directory)


@contextlib.contextmanager
def playing(run_dir: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tools.cli", "log", "play", *words, "--run-dir", str(run_dir)]
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str]) -> Ended:
    out, _ = process.communicate(timeout=PATIENCE_S)
    return Ended(process.returncode, out)


class Ear:
    """Takes everything that comes on some keys."""

    def __init__(self, session: Session, expression: str) -> None:
        self._stream = session.stream([expression], capacity=1_000_000)
        self.received: list[tuple[str, bytes]] = []

    def until(self, enough: Callable[[], bool]) -> bool:
        deadline = time.monotonic() + PATIENCE_S
        while not enough():
            item = self._stream.take()
            if item is not None:
                self.received.append(item[:2])
            elif time.monotonic() > deadline:
                return False
            else:
                time.sleep(0.001)
        return True

    def all(self, process: subprocess.Popen[str]) -> list[tuple[str, bytes]]:
        """Return what has come when the player has ended and nothing more comes."""
        assert self.until(lambda: process.poll() is not None)
        quiet = time.monotonic() + 0.5
        while time.monotonic() < quiet:
            item = self._stream.take()
            if item is not None:
                self.received.append(item[:2])
                quiet = time.monotonic() + 0.5
        return self.received


@contextlib.contextmanager
def listening(run_dir: Path, expression: str = "replay/**") -> Iterator[Ear]:
    with open_session(ROBOT, "ear", run_dir, connect=[LISTEN]) as session:
        yield Ear(session, expression)


def test_a_subscriber_gets_every_message_in_the_recorded_order_byte_for_byte(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also as fast as it can. Stops too are under no key but one below `replay/`."""
    rows = items(30.0, *KINDS)
    log = write(tmp_path / "log", rows, monkeypatch, parts=3)
    words = (log, "--rate", "1000", "--wait", "60")
    with listening(run_dir, "**") as ear, playing(run_dir, *words) as process:
        assert ear.all(process) == [(f"replay/{key}", payload) for key, payload, _ in rows]
        done = ended(process)
    assert done.code == 0, done.out
    assert f"{len(rows)} messages on 4 keys" in done.out
    assert "all sent" in done.out
    assert not list(run_dir.glob("*")), "the player's socket is gone"


def test_a_loop_runs_until_a_signal_and_then_reports_its_counts_and_leaves_nothing(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(60.0)
    log = write(tmp_path, rows, monkeypatch)
    with listening(run_dir) as ear, playing(run_dir, log, "--wait", "60") as process:
        assert ear.until(lambda: len(ear.received) >= 100)
        second = subprocess.run(process.args, cwd=ROOT, capture_output=True, text=True, check=False)
        assert second.returncode == 2
        assert "in use" in second.stdout + second.stderr
        process.send_signal(signal.SIGINT)
        done = ended(process)
    assert done.code == 128 + signal.SIGINT, done.out
    assert "messages on 3 keys" in done.out
    assert "Traceback" not in done.out
    assert not list(run_dir.glob("*"))
    assert [payload for _, payload in ear.received] == [
        row[1] for row in itertools.islice(itertools.cycle(rows), len(ear.received))
    ]
