"""The recorder's look at its host: a run directory whose disk fills is told while it lasts."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from services.recorder import host_watch
from services.recorder.disk_guard import MIB
from services.recorder.host_watch import RUN_DIR_MIN_MIB, HostWatch
from shared.bus.sockets import Arrivals
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
    watch = HostWatch(Arrivals(()), tmp_path, logging.getLogger("xrl"), 0)
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
