"""`xrl doctor` on the emulated robot, from the command line to the last line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared.process import DEFAULT_CONFIG
from tools import cli
from tools.supervision import procfs

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

AXIS = "knee_left.axis0"
TRAPS = {
    "controller.config.vel_limit": ("2", "60"),
    "config.can.encoder_rate_ms": ("10", "2"),
    "controller.config.vel_integrator_gain": ("0.333", "0"),
}
MEASURED = ("heartbeat", "encoder frames", "load cells", "processors")
"""What depends on how busy the machine is."""
START_S = 60.0


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as folder:
        path = Path(folder) / "r"
        yield path
        assert procfs.fleet_pids(path) == set(), "no process is left"
        assert not path.exists(), "and no file"


def doctor(run_dir: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the verb in a process of its own: the stand-in of libusb is for a whole process."""
    command = [sys.executable, "-m", "tools.cli", "doctor", "--run-dir", str(run_dir), *arguments]
    environment = {**os.environ, "COLUMNS": "100"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def rows_of(result: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    report = json.loads(result.stdout)
    rows = [row for group in report["groups"].values() for row in group]
    assert report["wrong"] == sum(row["verdict"] == "wrong" for row in rows)
    return rows


def test_nothing_is_wrong_with_the_emulated_robot_as_shipped(run_dir: Path) -> None:
    result = doctor(run_dir, "--json")
    assert result.returncode == 0, result.stdout + result.stderr
    rows = rows_of(result)
    bad = [row for row in rows if row["verdict"] != "ok"]
    assert [row for row in bad if row["what"] not in MEASURED] == []
    whats = [row["what"] for row in rows]
    assert whats.count("settings") == 6
    assert whats.count("calibrated") == 12
    assert whats.count("zero") == 6
    assert whats.count("heartbeat") == 12
    assert {"load cells", "gain schedule", "endpoints", "real-time priority"} <= set(whats)


def test_three_planted_traps_are_named_all_three(run_dir: Path) -> None:
    plants = [f"--plant={AXIS}.{name}={found}" for name, (found, _) in TRAPS.items()]
    result = doctor(run_dir, "--json", *plants)
    assert result.returncode == 1, result.stderr
    wrong = [row for row in rows_of(result) if row["verdict"] == "wrong"]
    assert {(row["subject"], row["what"]): (row["found"], row["wanted"]) for row in wrong} == {
        (AXIS, name): values for name, values in TRAPS.items()
    }
    assert {row["fix"] for row in wrong} == {"`xrl configure --apply --module knee_left`"}
    periods = [row for row in rows_of(result) if row["what"] == "encoder frames"]
    assert next(row for row in periods if row["subject"] == AXIS)["verdict"] == "warning"


def test_the_terminal_ends_in_what_is_wrong(run_dir: Path) -> None:
    result = doctor(run_dir, f"--plant={AXIS}.motor.config.pre_calibrated=false")
    assert result.returncode == 1
    words = " ".join(result.stdout.split())
    last = words[words.rindex("2 wrong:") :]
    assert last.startswith(f"2 wrong: {AXIS} pre_calibrated, {AXIS} calibrated")


def test_ctrl_c_stops_the_simulator_that_was_started(run_dir: Path) -> None:
    command = [sys.executable, "-m", "tools.cli", "doctor", "--run-dir", str(run_dir)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    )
    deadline = time.monotonic() + START_S
    while not (run_dir / "can_knee_left.sock").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors.decode()
    assert b"Traceback" not in errors


@pytest.mark.parametrize(
    ("plant", "says"),
    [
        ("knee_left.axis0.vel_limit=2", "the nearest is axis0.controller.config.vel_limit"),
        ("knee_lft.axis0.controller.config.vel_limit=2", "the nearest is knee_left"),
    ],
)
def test_a_plant_that_makes_no_sense_starts_nothing(
    run_dir: Path, capsys: pytest.CaptureFixture[str], plant: str, says: str
) -> None:
    assert cli.main(["doctor", "--run-dir", str(run_dir), "--plant", plant]) == 2
    assert says in capsys.readouterr().err


def test_nothing_is_planted_in_real_drives(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = DEFAULT_CONFIG.read_text(encoding="utf-8").replace('"xrl_unix"', '"socketcan"')
    real = tmp_path / "real.toml"
    real.write_text(text, encoding="utf-8")
    plant = f"--plant={AXIS}.controller.config.vel_limit=2"
    assert cli.main(["doctor", "--config", str(real), "--run-dir", str(run_dir), plant]) == 2
    assert "real ones" in capsys.readouterr().err
