"""The crash matrix on the real fleet: one case to its end, and one that is interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from shared.places import CHECKOUT
from tests.system.fleets import command, leaving_nothing, xrl_led

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]


def test_the_robot_stands_when_a_knees_service_is_killed_in_the_squat(tmp_path: Path) -> None:
    with leaving_nothing():
        done = xrl_led("study crash", tmp_path, "--only", "kill-knee_left")
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["complete"] is True
    (row,) = document["cases"]
    assert row["verdict"] == "stood"
    assert row["safe_ms"] is not None
    assert "kill-knee_left" in (tmp_path / "junit.xml").read_text()
    assert (tmp_path / "kill-knee_left" / "logs" / "knee_left.log").is_file()


def test_an_interrupted_matrix_leaves_nothing_behind(tmp_path: Path) -> None:
    with leaving_nothing() as mine:
        process = subprocess.Popen(
            command("study", "crash", "--only", "kill-*", "--out", tmp_path), cwd=CHECKOUT,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        while not mine():
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        time.sleep(2.0)  # in the middle of its start
        os.killpg(process.pid, signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "stopped; 0 of" in output
