"""The whole fleet with its drives on USB, live, as `test_demo.py` has it on CAN. Outcomes only."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.bus import topics
from shared.bus.messages import Mode, RunEventKind
from shared.joints import MODULES
from tests.system.fleets import leaving_nothing, xrl_led
from tests.system.stalls import stood
from tests.usb import robot_file
from tools.logs.run_log import read_run

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]


def test_a_killed_services_successor_takes_over_and_an_unplugged_drive_holds(
    tmp_path: Path,
) -> None:
    """The planner knows no drive: a kill of it is the same on CAN (test_agreement)."""
    out = tmp_path / "out"
    killed = ("--kill", "knee_left@1", "--restart", "knee_left@1.5")
    unplugged = ("--fault", "knee_left:link_lost@5:1")
    with leaving_nothing():
        config = ("--config", robot_file.write(tmp_path))
        done = xrl_led("demo", out, *config, "--duration", "6.5", *killed, *unplugged)
    assert stood(done.returncode, out), done.stdout + done.stderr
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
