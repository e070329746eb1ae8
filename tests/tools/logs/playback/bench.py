"""A bus, a player as a person types it, subscribers and a joint service: for tests."""

from __future__ import annotations

import contextlib
import itertools
import os
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
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import sample
from tools.verbs.log.play import LISTEN

ROOT = DEFAULT_CONFIG.parents[1]
ROBOT = config_file.load(DEFAULT_CONFIG)
NAME = ROBOT.name
PATIENCE_S = 30.0
BEGAN = 5_000_000_000
STATE = topics.JOINT_STATE.key(NAME, "knee_left")
WRENCH = topics.WRENCH.key(NAME)
TRUTH = topics.SIM_TRUTH.key(NAME)

Item = tuple[str, bytes, int]


class Ended(NamedTuple):
    code: int
    out: str


def items(seconds: float = 1.0) -> list[Item]:
    """Return states, wrenches and truths, 100 of each for each second."""
    found: list[Item] = []
    rows: tuple[tuple[str, type[Message]], ...] = (
        (STATE, JointState),
        (WRENCH, Wrench),
        (TRUTH, SimTruth),
    )
    for n in range(round(100 * seconds)):
        for k, (key, kind) in enumerate(rows):
            t_ns = BEGAN + 10_000_000 * n + 1_000_000 * k
            found.append((key, codec.encode(sample(kind, seq=n, t_ns=t_ns)), t_ns + 77))
    return found


def write(
    directory: Path, rows: list[Item], monkeypatch: pytest.MonkeyPatch, parts: int = 1
) -> Path:
    """Write a run of the shipped robot, in one file or several, and return its directory."""
    monkeypatch.setitem(runs.METADATA, "run", {**runs.METADATA["run"], "robot": NAME})
    monkeypatch.setitem(runs.ATTACHMENTS, "robot.toml", config_file.to_toml(ROBOT).encode())
    runs.write_in_parts(runs.writer(directory, keys=topics.all_keys(NAME)), rows, parts)
    return directory


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


def play(run_dir: Path, *words: str) -> Ended:
    with playing(run_dir, *words) as process:
        return ended(process)


class Ear:
    """Takes all that comes on some keys."""

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

    def has(self, count: int) -> bool:
        """Return True once so many messages have come."""
        return self.until(lambda: len(self.received) >= count)

    def all(self, process: subprocess.Popen[str]) -> list[tuple[str, bytes]]:
        """Return what has come when the player has ended and nothing more comes."""
        assert self.until(lambda: process.poll() is not None)
        self.quiet()
        return self.received

    def quiet(self) -> int:
        """Return how many messages have come, once no more do."""
        quiet = time.monotonic() + 0.5
        while time.monotonic() < quiet:
            item = self._stream.take()
            if item is not None:
                self.received.append(item[:2])
                quiet = time.monotonic() + 0.5
        return len(self.received)


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
        self.commands = self.estops = 0
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
                self.commands += commands.take() is not None
                self.estops += estops.take() is not None
                time.sleep(0.004)


def command_items() -> list[Item]:
    """Return two seconds of commands to the knee, and of emergency stops."""
    key, stop = topics.JOINT_COMMAND.key(NAME, "knee_left"), topics.ESTOP.key(NAME)
    found: list[Item] = []
    for n in range(200):
        t_ns = BEGAN + 10_000_000 * n
        found.append((key, codec.encode(sample(JointCommand, seq=n, t_ns=t_ns)), t_ns))
        found.append((stop, codec.encode(sample(Estop, seq=n, t_ns=t_ns)), t_ns + 1))
    return found
