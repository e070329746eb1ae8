"""The recorder's look at its host: a run directory whose disk fills is told while it lasts."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.recorder import host_watch
from services.recorder.host_watch import (
    MIB,
    RUN_DIR_MIN_MIB,
    DiskChange,
    RunDirWatch,
    SpaceGuard,
)
from shared.clock import NS_PER_S


def test_a_run_directory_whose_disk_fills_is_told_until_there_is_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    free = [100 * RUN_DIR_MIN_MIB]

    def free_at(path: Path) -> int:
        assert path == tmp_path
        if free[0] < 0:
            raise OSError(5, "Input/output error")
        return free[0] * MIB

    monkeypatch.setattr(host_watch, "free_bytes_at", free_at)
    watch = RunDirWatch(tmp_path, logging.getLogger("xrl"), 0)
    now_ns = 0

    def look(free_mib: int) -> str:
        nonlocal now_ns
        free[0], now_ns = free_mib, now_ns + 3 * NS_PER_S
        watch.check_if_due(now_ns)
        return watch.trouble

    assert look(100 * RUN_DIR_MIN_MIB) == ""
    assert look(RUN_DIR_MIN_MIB - 1) == (
        f"{tmp_path}: {RUN_DIR_MIN_MIB - 1} MiB free: logs lose lines; free some space"
    )
    assert "logs lose lines" in caplog.text
    assert look(0).startswith(f"{tmp_path}: 0 MiB free")
    assert look(-1) == f"{tmp_path}: Input/output error"
    assert look(100 * RUN_DIR_MIN_MIB) == ""


def changes(least_mib: float, *free_mib: float) -> list[DiskChange]:
    guard = SpaceGuard(least_mib)
    return [guard.feed(round(free * MIB)) for free in free_mib]


NONE, LOW, FULL, BACK = DiskChange
CASES = {
    "it warns once before it stops": (100, (900, 201, 199, 150, 101), [NONE, NONE, LOW]),
    "it stops below the limit once": (100, (99, 50, 0), [FULL]),
    "it goes on when there is clearly more": (100, (99, 101, 149, 151), [FULL, NONE, NONE, BACK]),
    "a disk that hovers is told once": (100, (199, 201, 199, 240, 199), [LOW]),
    "and again after clearly more": (100, (199, 300, 199), [LOW, NONE, LOW]),
    "zero switches it off": (0, (0, 0), []),
}
"""Least space, free space look by look, and what changes; NONE after the last."""


@pytest.mark.parametrize(("least", "free", "expected"), CASES.values(), ids=CASES)
def test_what_changes_by_the_free_space(
    least: float, free: tuple[float, ...], expected: list[DiskChange]
) -> None:
    assert changes(least, *free) == expected + [NONE] * (len(free) - len(expected))


@given(st.lists(st.floats(0, 400)))
def test_it_never_lets_recording_go_on_below_the_limit(free_mib: list[float]) -> None:
    guard = SpaceGuard(100)
    for free in free_mib:
        before = guard.enough
        change = guard.feed(round(free * MIB))
        assert guard.enough or change in (DiskChange.FULL, DiskChange.NONE)
        assert (change is DiskChange.BACK) == (guard.enough and not before)
        assert (change is DiskChange.FULL) == (before and not guard.enough)
        if round(free * MIB) < 100 * MIB:
            assert not guard.enough
