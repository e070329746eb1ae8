from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from shared.mcap_log import files
from shared.mcap_log.files import FsyncThread
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import Queue, item


class SlowDisk:
    """An fsync that ends when the test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.let_go = threading.Event()
        self.asked = threading.Event()
        self.synced = 0
        monkeypatch.setattr(files.os, "fsync", self._sync)

    def _sync(self, descriptor: int) -> None:
        os.fstat(descriptor)  # still open
        self.asked.set()
        assert self.let_go.wait(30.0)
        self.synced += 1


def test_a_slow_disk_holds_up_no_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = SlowDisk(monkeypatch)
    run = runs.writer(tmp_path)
    for seq in range(100):
        assert run.take_from(Queue([item(seq)]), 10) == 1
        run.sync()
    assert disk.asked.wait(30.0)
    assert disk.synced == 0
    disk.let_go.set()
    run.__exit__(None, None, None)
    assert run.messages == 100
    assert 1 <= disk.synced < 10, "what waits is synced together"


def test_a_file_that_is_closed_meanwhile_is_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = SlowDisk(monkeypatch)
    waiting = FsyncThread()
    for name in ("a", "b"):
        with (tmp_path / name).open("wb") as file:
            waiting.request(file.fileno(), last=True)
    disk.let_go.set()
    waiting.settle()
    waiting.close()
    assert disk.synced == 2
