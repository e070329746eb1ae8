"""The watch beside a live fleet: how long the machine ran nothing."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from tests.system import stalls
from tests.system.stalls import gaps_in
from tools.fleet.stall_watch import CORES_MAX, Gap, StallWatch


def test_a_stall_is_measured_as_long_as_it_was_on_every_core(tmp_path: Path) -> None:
    found: list[Gap] = []
    with StallWatch(tmp_path / "gaps") as watch:
        process = watch._process
        deadline = time.monotonic() + 20.0
        time.sleep(0.5)  # it is up by then; if it is not, less is claimed
        is_bound = os.sched_getscheduler(process.pid) == os.SCHED_FIFO
        cores = len(os.sched_getaffinity(0))
        wanted = cores if is_bound and cores <= CORES_MAX else 1
        begin_ns = time.monotonic_ns()
        os.kill(process.pid, signal.SIGSTOP)  # what a machine that stalls does to all
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGCONT)
        while len({gap.core for gap in found if gap.lasted_ns > 250_000_000}) < wanted:
            assert time.monotonic() < deadline
            found += [gap for gap in watch.take() if gap.end_ns > begin_ns]
            time.sleep(0.01)
    assert process.poll() is not None
    assert len(found) == len(set(found)), "each gap is given once"
    assert set(found) <= set(gaps_in(tmp_path / "gaps", begin_ns))


def test_only_whole_lines_from_a_time_on_are_read(tmp_path: Path) -> None:
    path = tmp_path / "gaps"
    path.write_text("100 30 0 0\n200 40 1 10\n300 5")
    assert gaps_in(path) == [Gap(100, 30, 0, 0), Gap(200, 40, 1, 10)]
    assert gaps_in(path, from_ns=150) == [Gap(200, 40, 1, 10)]


def test_a_line_that_is_half_written_is_taken_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "gaps"
    with StallWatch(path) as watch:
        watch._process.kill()
        path.write_text("100 30 0 0\n20")
        assert watch.take() == [Gap(100, 30, 0, 0)]
        assert watch.take() == []
        path.write_text("100 30 0 0\n200 40 1 10\n")
        assert watch.take() == [Gap(200, 40, 1, 10)]


def test_no_process_is_excused_without_a_measured_stall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "gaps"
    path.write_text(f"{10**12} 50000000 0 0\n")
    monkeypatch.delenv(stalls.FILE_VARIABLE, raising=False)
    assert not stalls.has_stalled(0), "nothing was measured"
    monkeypatch.setenv(stalls.FILE_VARIABLE, str(path))
    assert stalls.has_stalled(10**12)
    assert not stalls.has_stalled(10**12 + 1)
