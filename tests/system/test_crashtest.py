"""The crash matrix on the real fleet: one case to its end, and one that is interrupted."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.system.stalls import stalled_before_it_began
from tools.fleet import procfs

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = "xrl-crash-*"


def command(out: Path, name: str) -> list[str]:
    return [sys.executable, "-m", "tools.cli", "study", "crash", "--only", name, "--out", str(out)]


def crash_fleets() -> set[str]:
    return {fleet for fleet in procfs.fleets() if fleet.startswith("/tmp/xrl-crash-")}


def test_the_robot_stands_when_a_knees_service_is_killed_in_the_squat(tmp_path: Path) -> None:
    before, folders = crash_fleets(), set(Path("/tmp").glob(FOLDERS))
    done = subprocess.run(
        command(tmp_path, "kill-knee_left"),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
    )
    if stalled_before_it_began(done.returncode, done.stdout + done.stderr, tmp_path):
        pytest.skip("this machine stalled so often that the squat could not begin")
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["complete"] is True
    (row,) = document["cases"]
    assert row["verdict"] == "stood"
    assert row["safe_ms"] is not None
    assert "kill-knee_left" in (tmp_path / "junit.xml").read_text()
    assert (tmp_path / "kill-knee_left" / "logs" / "knee_left.log").is_file()
    assert crash_fleets() <= before
    assert set(Path("/tmp").glob(FOLDERS)) <= folders


def test_an_interrupted_matrix_leaves_nothing_behind(tmp_path: Path) -> None:
    before, folders = crash_fleets(), set(Path("/tmp").glob(FOLDERS))
    process = subprocess.Popen(
        command(tmp_path, "kill-*"),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not crash_fleets() - before:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    time.sleep(2.0)  # in the middle of its start
    os.killpg(process.pid, 2)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "stopped; 0 of" in output
    assert crash_fleets() <= before
    assert set(Path("/tmp").glob(FOLDERS)) <= folders
