"""`xrl log play` on a real bus, as a person types it, with real subscribers."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from shared.bus import codec, topics
from shared.bus.messages import Estop, JointCommand, JointState, Message, Wrench
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
COMMAND = topics.JOINT_COMMAND.key(NAME, "knee_left")
STOP = topics.ESTOP.key(NAME)
KINDS: dict[str, type[Message]] = {
    STATE: JointState, WRENCH: Wrench, TRUTH: SimTruth, COMMAND: JointCommand, STOP: Estop,
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
    runs.write_in_parts(runs.writer(directory, keys=topics.all_keys(NAME)), rows, parts)
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


class LiveJoint:
    """A joint service as far as the bus knows: states out, commands and estop in."""

    def __init__(self, run_dir: Path, module: str = "knee_left") -> None:
        self._run_dir, self._module = run_dir, module
        self._over = threading.Event()
        self._up = threading.Event()
        self.taken = 0
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> LiveJoint:
        self._thread.start()
        assert self._up.wait(PATIENCE_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _serve(self) -> None:
        with open_session(ROBOT, self._module, self._run_dir) as session:
            states = session.publisher(topics.JOINT_STATE, JointState, self._module)
            commands = session.latest(topics.JOINT_COMMAND, JointCommand, self._module)
            estops = session.latest(topics.ESTOP, Estop)
            self._up.set()
            for n in itertools.count():
                if self._over.is_set():
                    return
                states.put(sample(JointState, seq=n, t_ns=time.monotonic_ns()))
                self.taken += (commands.take() is not None) + (estops.take() is not None)
                time.sleep(0.004)


def test_a_subscriber_gets_every_message_in_the_recorded_order_byte_for_byte(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also as fast as it can, and under no other key than one below `replay/`."""
    rows = items(60.0)
    log = write(tmp_path / "log", rows, monkeypatch, parts=3)
    words = (log, "--rate", "1000", "--wait", "60")
    with listening(run_dir, "**") as ear, playing(run_dir, *words) as process:
        assert ear.all(process) == [(f"replay/{key}", payload) for key, payload, _ in rows]
        done = ended(process)
    assert done.code == 0, done.out
    assert f"{len(rows)} messages on 3 keys" in done.out
    assert "all sent" in done.out
    assert not list(run_dir.glob("*")), "the player's socket is gone"


STANDS_STILL = """
import os, signal, sys, time
from pathlib import Path
from shared.bus.session import open_session
from tests.system.test_play import LISTEN, ROBOT
with open_session(ROBOT, "ear", Path(sys.argv[1]), connect=[LISTEN]) as session:
    stream = session.stream(["replay/**"], capacity=1_000_000)
    while stream.take() is None:
        pass
    os.kill(os.getpid(), signal.SIGSTOP)
    heard, deadline = 1, time.monotonic() + 10.0
    while heard < int(sys.argv[2]) and time.monotonic() < deadline:
        heard += stream.take() is not None
    print(heard)
"""


def test_the_end_is_not_lost_to_a_subscriber_that_stands_still_for_half_a_second(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(3.0)  # more than a socket takes, less than the player's queue besides
    log = write(tmp_path, rows, monkeypatch)
    with playing(run_dir, log, "--rate", "1000", "--wait", "60") as process:
        command = [sys.executable, "-c", STANDS_STILL, str(run_dir), str(len(rows))]
        ear = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        try:
            os.waitpid(ear.pid, os.WUNTRACED)
            time.sleep(0.5)
            ear.send_signal(signal.SIGCONT)
            assert ended(process).code == 0
            assert ear.communicate(timeout=30)[0] == f"{len(rows)}\n"
        finally:
            ear.kill()
            ear.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_player_that_is_ended_by_a_signal_reports_its_counts_and_leaves_nothing(
    number: signal.Signals, run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = items(60.0)
    log = write(tmp_path, rows, monkeypatch)
    with listening(run_dir) as ear, playing(run_dir, log, "--wait", "60") as process:
        assert ear.until(lambda: len(ear.received) >= 100)
        second = subprocess.run(process.args, cwd=ROOT, capture_output=True, text=True, check=False)
        assert second.returncode == 2
        assert "in use" in second.stdout + second.stderr
        process.send_signal(number)
        done = ended(process)
    assert done.code == 128 + number, done.out
    assert "messages on 3 keys" in done.out
    assert "Traceback" not in done.out
    assert not list(run_dir.glob("*"))
    received = [payload for _, payload in ear.received]
    assert received == [row[1] for row in rows[: len(received)]]


def test_recorded_commands_and_stops_reach_no_live_joint_service(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write(tmp_path, items(2.0, COMMAND, STOP), monkeypatch)
    with (
        LiveJoint(run_dir) as joint,
        listening(run_dir) as ear,
        playing(run_dir, log, "--rate", "5", "--wait", "60") as process,
    ):
        assert len(ear.all(process)) == 400
        assert process.returncode == 0
        assert joint.taken == 0
