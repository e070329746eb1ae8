"""`xrl demo` and `xrl study crash` on the real fleet: falls, Ctrl-C, a stall, a case of the matrix.

Outcomes only, no milliseconds. How the demo survives its planner, and what it records of that:
test_agreement.
"""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from shared.bus import topics
from shared.clock import PACE_FILE
from shared.places import CHECKOUT
from shared.run_directory import live_dir
from tests.system.fleets import command, leaving_nothing, xrl_led
from tests.system.stalls import stalled_before_it_began
from tools.fleet import procfs
from tools.fleet.stalls import stalls_of
from tools.logs.run_log import read_run

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]


def test_a_robot_that_cannot_stand_is_a_finding_and_not_an_error(tmp_path: Path) -> None:
    result = xrl_led("demo", tmp_path, "--push", "0.1:3:0,250,0", "--duration", "6")
    assert result.returncode == 1, result.stdout + result.stderr
    assert "FELL" in result.stdout
    assert json.loads((tmp_path / "summary.json").read_text())["stood"] is False


def test_one_that_is_interrupted_leaves_nothing_behind(tmp_path: Path) -> None:
    with leaving_nothing() as mine:
        process = subprocess.Popen(
            command("demo", "--out", tmp_path), cwd=CHECKOUT,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        while not mine():
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        time.sleep(2.0)  # in the middle of its start
        os.killpg(process.pid, signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in output


def test_the_robot_stands_when_a_knees_service_is_killed_in_the_squat(tmp_path: Path) -> None:
    with leaving_nothing():
        done = xrl_led("study crash", tmp_path, "--only", "kill-knee_left")
    assert done.returncode == 0, done.stdout + done.stderr
    with (tmp_path / "cases.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["name"], row["verdict"]) == ("kill-knee_left", "stood")
    assert row["safe_ms"]
    assert (tmp_path / "kill-knee_left" / "logs" / "knee_left.log").is_file()


def test_a_stall_of_the_machine_is_marked_in_line_record_and_verdict(tmp_path: Path) -> None:
    words = command("demo", "--out", tmp_path, "--duration", "3.5", "--kill", "planner@3")
    said, stopped = list[str](), False
    with (
        leaving_nothing() as mine,
        subprocess.Popen(words, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if not stopped and re.match(r" +[1-9]\.\d+ s ", line):
                (run_dir,) = map(Path, mine())
                stop_all([process.pid, *procfs.service_pids(run_dir).values()], run_dir, 0.12)
                stopped = True
    text = "".join(said)
    if stalled_before_it_began(process.returncode, text, tmp_path):
        pytest.skip("this machine stalled so often that the scenario could not begin")
    assert process.returncode == 0, text
    live, _, verdict = text.partition("Verdict")
    assert re.search(r"stalled for \d+ ms: all six held", live), text
    assert re.search(r"\d s: .* stalled for \d+ ms: all six held", verdict), text
    log = read_run(tmp_path / "run.mcap")
    longest_ms = max(row.lasted_ms for row in stalls_of(log.messages(topics.RUN_EVENT)))
    assert longest_ms > 100.0, "of the 120 ms"


def stop_all(pids: Sequence[int], run_dir: Path, for_s: float) -> None:
    """Stop the services and the tool for a time of the fleet's clock, as a machine that stalls."""
    slow = live_dir(run_dir) / PACE_FILE
    pace = float(slow.read_text()) if slow.exists() else 1.0
    procfs.signal_all(pids, signal.SIGSTOP)
    time.sleep(for_s / pace)
    procfs.signal_all(pids, signal.SIGCONT)
