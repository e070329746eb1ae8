"""The watch beside the live tests: how long the machine ran nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system import stalls
from tests.system.stall_watch import Gap, gaps_in


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    path = tmp_path / "gaps"
    program = Path(stalls.__file__).with_name("stall_watch.py")
    with subprocess.Popen([sys.executable, str(program), str(path)]) as process:
        while not path.exists():
            assert process.poll() is None
            time.sleep(0.01)
        yield process, path
        process.kill()


def test_a_stall_is_measured_as_long_as_it_was(
    watched: tuple[subprocess.Popen[bytes], Path],
) -> None:
    process, path = watched
    time.sleep(0.1)
    begin_ns = time.monotonic_ns()
    os.kill(process.pid, signal.SIGSTOP)  # what a machine that stalls does to all
    time.sleep(0.3)
    os.kill(process.pid, signal.SIGCONT)
    deadline = time.monotonic() + 20.0
    while not gaps_in(path, begin_ns):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert max(gap.lasted_ns for gap in gaps_in(path, begin_ns)) > 250_000_000


def test_only_whole_lines_from_a_time_on_are_read(tmp_path: Path) -> None:
    path = tmp_path / "gaps"
    path.write_text("100 30\n200 40\n300 5")
    assert gaps_in(path) == [Gap(100, 30), Gap(200, 40)]
    assert gaps_in(path, from_ns=150) == [Gap(200, 40)]


def test_no_process_is_excused_without_a_measured_stall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "gaps"
    path.write_text(f"{10**12} 50000000\n")
    monkeypatch.delenv(stalls.FILE_VARIABLE, raising=False)
    assert not stalls.has_stalled(0), "nothing was measured"
    monkeypatch.setenv(stalls.FILE_VARIABLE, str(path))
    assert stalls.has_stalled(10**12)
    assert not stalls.has_stalled(10**12 + 1)
