"""The dead man's handle: it is held, laid down, or gone; nothing else is between."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from services.joint.neighbours import NeighbourRow, Neighbours
from services.joint.rearm_guard import RearmGuard
from shared.bus.messages import Mode
from shared.joints import MODULES
from tests.waiting import comes_true
from tools import cli

ROOT = Path(__file__).parents[3]
PATIENCE_S = 30.0


@pytest.fixture
def files(tmp_path: Path) -> list[RearmGuard]:
    """Return what six joint services of a fleet have open."""
    return [RearmGuard(tmp_path, module) for module in MODULES]


@contextmanager
def held(
    run_dir: Path, files: list[RearmGuard], stdin: int = subprocess.DEVNULL
) -> Iterator[subprocess.Popen[str]]:
    """Give a pendant that beats, in a process of its own."""
    command = [sys.executable, "-m", "tools.cli", "pendant", "--run-dir", str(run_dir)]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, cwd=ROOT, stdin=stdin, stdout=pipe, stderr=pipe, text=True
    ) as process:
        try:
            assert comes_true(lambda: all(file.beats > 3 for file in files), PATIENCE_S)
            yield process
        finally:
            process.kill()


def test_beside_it_a_second_is_refused_and_after_a_kill_it_sends_no_more(
    tmp_path: Path, files: list[RearmGuard], capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside a second one the first would not be missed."""
    with held(tmp_path, files):
        assert cli.main(["pendant", "--run-dir", str(tmp_path)]) == 2
    assert "another pendant is active" in capsys.readouterr().err
    beats = [file.beats for file in files]
    assert min(beats) > 3
    time.sleep(0.1)
    assert [file.beats for file in files] == beats, "and the services' rule does the rest"


def test_enter_lays_it_down(tmp_path: Path, files: list[RearmGuard]) -> None:
    person, terminal = pty.openpty()
    with held(tmp_path, files, terminal) as process:
        os.write(person, b"\n")
        said, _ = process.communicate(timeout=PATIENCE_S)
    os.close(person)
    os.close(terminal)
    assert process.returncode == 0
    assert "laid down" in said
    assert [file.beats for file in files] == [0] * 6


def test_ctrl_c_is_the_stop_and_names_the_services_that_have_not_stopped(
    tmp_path: Path, files: list[RearmGuard]
) -> None:
    """Five services stop in this test, the sixth does not hear it."""
    for module in MODULES:
        mode = Mode.DAMP if module != "hip_left" else Mode.HOLD
        Neighbours(tmp_path, module).write(NeighbourRow(1, 0.0, 0.0, mode))
    with held(tmp_path, files) as process:
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "hip_left" in error
    assert "knee_left" not in error
    assert all(file.stop_requested for file in files), "at once, and not by silence"


def test_a_terminal_that_is_cut_is_the_stop(tmp_path: Path, files: list[RearmGuard]) -> None:
    """Its hang-up ends the program; one that was started to outlive it stops all the same."""
    person, terminal = pty.openpty()
    with held(tmp_path, files, terminal) as process:
        os.close(terminal)
        os.close(person)
        assert comes_true(lambda: all(file.stop_requested for file in files), PATIENCE_S)
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2, "no service is there to stop"


def test_a_time_lays_it_down_by_itself(
    tmp_path: Path, files: list[RearmGuard], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["pendant", "--for", "0.1", "--run-dir", str(tmp_path)]) == 0
    assert "laid down" in capsys.readouterr().out
    assert files[3].beats == 0
