"""Nothing of a running fleet is for others, whatever the umask of who started it."""

from __future__ import annotations

import stat
import subprocess
from pathlib import Path

import pytest

from shared.run_directory import live_dir
from tests.system.fleets import command, wait_for
from tools import cli

pytestmark = pytest.mark.system

SHARED_MEMORY = Path("/dev/shm")


def test_a_fleet_that_was_started_with_umask_0_leaves_nothing_to_others(
    run_dir: Path, tmp_path: Path
) -> None:
    before = set(SHARED_MEMORY.iterdir())
    out = tmp_path / "record"
    only = ("--only", "ankle_right,simulator,recorder", "--scenario", "stand")
    words = command("up", "--run-dir", run_dir, "--out", out, *only)
    script = 'umask 0; exec "$@"'
    try:
        subprocess.run(["bash", "-c", script, "-", *words], check=True, timeout=90)
        # "up" is a service that listens; what else it opens follows, on a busy machine later
        opened = (live_dir(run_dir) / "ankle_right.rearm", live_dir(run_dir) / "joints.near")
        assert wait_for(lambda: all(path.exists() for path in opened) and any(out.glob("*.mcap")))
        folders = (run_dir, live_dir(run_dir))
        found = [*folders, *(path for folder in folders for path in folder.rglob("*"))]
        found += set(SHARED_MEMORY.iterdir()) - before
        modes = {str(path): stat.S_IMODE(path.lstat().st_mode) for path in found}
        assert {path.suffix for path in found} >= {".rearm", ".near", ".log"}
        assert {path: oct(mode) for path, mode in modes.items() if mode & 0o077} == {}
        (record,) = out.glob("*.mcap")
        assert stat.S_IMODE(record.stat().st_mode) == 0o640
    finally:
        assert cli.main(["down", "--run-dir", str(run_dir)]) == 0
