"""The whole fleet with its drives on USB, live, as `test_demo.py` has it on CAN. Outcomes only."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shared.joints import MODULES
from tests.system.fleets import leaving_nothing, xrl_led
from tests.usb import robot_file

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]


@pytest.fixture
def robot_path(tmp_path: Path) -> Path:
    return robot_file.write(tmp_path)


def led(verb: str, out: Path, *flags: str | Path) -> str:
    """Run a verb that has to end well; return what it printed."""
    with leaving_nothing():
        done = xrl_led(verb, out, *flags)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.wide  # the planner knows no drive; what ends on USB is in the next
def test_it_stands_when_the_planner_is_killed(tmp_path: Path, robot_path: Path) -> None:
    out = tmp_path / "out"
    flags = ("--duration", "7", "--kill", "planner@3", "--push", "4:0.3:30,0,0")
    assert "STOOD" in led("demo", out, "--config", robot_path, *flags)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["stood"] is True
    assert set(summary["handover_ms"]) == set(MODULES)
    assert all(value is not None for value in summary["handover_ms"].values())


def test_a_killed_services_successor_takes_over_and_an_unplugged_drive_holds(
    tmp_path: Path, robot_path: Path
) -> None:
    """Both at once: what each does alone, it does beside the other."""
    out = tmp_path / "out"
    led("study crash", out, "--config", robot_path, "--only", "pair-knee-unplugged-hip")
    (row,) = json.loads((out / "results.json").read_text())["cases"]
    assert row["verdict"] == "stood"
    assert row["leads_again_s"] is not None
