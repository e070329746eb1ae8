"""The whole fleet with its drives on USB, live, as `test_demo.py` has it on CAN. Outcomes only."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shared.bus import topics
from shared.bus.messages import Mode, RunEventKind
from shared.joints import MODULES
from tests.system.fleets import leaving_nothing, xrl_led
from tests.usb import robot_file
from tools.logs.run_log import read_run

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
    out = tmp_path / "out"
    killed = ("--kill", "knee_left@1", "--restart", "knee_left@1.5")
    unplugged = ("--fault", "knee_left:link_lost@5:1")
    led("demo", out, "--config", robot_path, "--duration", "6.5", *killed, *unplugged)
    log = read_run(out / "run.mcap")
    (restarted,) = (
        row for row in log.messages(topics.RUN_EVENT) if row.kind == RunEventKind.RESTARTED
    )
    for module in MODULES:
        events = log.messages(topics.JOINT_EVENT, module)
        modes = [event.mode_after for event in events if event.t_ns > restarted.t_ns]
        assert Mode.TRACK in modes, f"{module} is led again beside the successor"
        if module != "knee_left":
            held = modes[modes.index(Mode.TRACK) :]
            assert Mode.HOLD in held, f"{module} holds with the drive that does"
