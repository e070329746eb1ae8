"""`xrl drive zero` and `xrl drive jog` on the emulated robot, as a person types them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import can
import msgspec
import pytest

from services.joint.__main__ import open_drive
from shared.bus.messages import DriveStatus, Mode
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.config.robot_config import RobotConfig, expand
from shared.joints import MODULES
from shared.places import CHECKOUT
from tests.system.fleets import command, heard, started, xrl
from tools.bringup import drive_access, zeroing
from tools.bringup.zeroing import DriveLook, look
from tools.fleet import procfs

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]

MODULE = "knee_left"
LEG = (MODULE, "--torque-limit", "40", "--yes")
"""On the hoist its sole rests on the floor."""


def lose_power(robot: RobotConfig, run_dir: Path, module: str) -> None:
    """Restart a module's drive: it then knows its motors within a turn only."""
    wiring = robot.module_named(module)
    wire = robot.can[wiring.bus]
    with can.Bus(interface=wire.interface, channel=expand(wire.channel, run_dir)) as bus:
        bus.send(
            can.Message(
                arbitration_id=cansimple.arbitration_id(wiring.node_ids[0], Command.REBOOT),
                is_extended_id=False,
            )
        )


def eventually_look(robot: RobotConfig, run_dir: Path, module: str, *, zeroed: bool) -> DriveLook:
    """Return what a drive says once it has a zero, or has none."""
    unmarked = msgspec.structs.replace(robot.drive, zero_mark_turns=0.0)
    drive = open_drive(msgspec.structs.replace(robot, drive=unmarked), module, run_dir)
    try:
        deadline = time.monotonic() + 20.0
        while True:
            seen = look(drive, robot)
            if seen.zeroed == zeroed and seen.status is not DriveStatus.LOST:
                return seen
            assert time.monotonic() < deadline, seen
    finally:
        drive.close()


def test_emulated_drives_are_zeroed_by_a_protractor_and_by_the_stand(
    run_dir: Path, robot: RobotConfig
) -> None:
    with started(run_dir, "simulator"):
        with heard(robot, run_dir) as ear:  # until it hangs still
            height = ear.world(after_s=drive_access.SETTLE_S).torso[2]
        true = {m: eventually_look(robot, run_dir, m, zeroed=True).q for m in MODULES}
        lose_power(robot, run_dir, MODULE)
        eventually_look(robot, run_dir, MODULE, zeroed=False)
        unasked = xrl("drive", "zero", MODULE, "--at", "0,-0.9", run_dir=run_dir)
        assert unasked.returncode == 2
        assert "unzeroed" in unasked.stdout
        assert "--yes" in unasked.stderr
        assert not eventually_look(robot, run_dir, MODULE, zeroed=False).zeroed
        done = xrl("drive", "zero", MODULE, "--at", "0.01,-0.9", "--yes", run_dir=run_dir)
        assert done.returncode == 0, done.stdout + done.stderr
        seen = eventually_look(robot, run_dir, MODULE, zeroed=True)
        assert seen.q == pytest.approx((0.01, -0.9), abs=zeroing.WITHIN)
        done = xrl("drive", "zero", "--all", "--standing", str(height), "--yes", run_dir=run_dir)
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stdout.count(" zeroed") >= len(MODULES)
        for module in MODULES:
            seen = eventually_look(robot, run_dir, module, zeroed=True)
            assert seen.q == pytest.approx(true[module], abs=0.01), "so it was from the start"


def test_beside_its_joint_service_a_module_is_zeroed_only_while_that_is_disarmed(
    run_dir: Path, robot: RobotConfig
) -> None:
    order = ("drive", "zero", MODULE, "--at", "0.03,-1.0", "--yes")
    with started(run_dir, "simulator", MODULE) as fleet, heard(robot, run_dir) as ear:
        ear.wait_for({MODULE: Mode.HOLD})
        held = xrl(*order, run_dir=run_dir)
        assert held.returncode == 2
        assert "holds it (HOLD)" in held.stderr
        lose_power(robot, run_dir, MODULE)
        ear.wait_for({MODULE: Mode.FAULT})
        faulty = xrl(*order, run_dir=run_dir)
        assert faulty.returncode == 2
        assert f"xrl kill {MODULE}" in faulty.stderr
        fleet.kill(MODULE)
        ear.wait_for({MODULE: Mode.DISARMED})
        eventually_look(robot, run_dir, MODULE, zeroed=False)
        done = xrl(*order, run_dir=run_dir)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "arms the drive as soon as it is zeroed" in " ".join(done.stdout.split())
        ear.wait_for({MODULE: Mode.HOLD})


def test_a_leg_of_the_emulated_robot_follows_and_nothing_is_left_behind(run_dir: Path) -> None:
    done = xrl("drive", "jog", *LEG, "--cycles", "1", run_dir=run_dir)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "FOLLOWED" in done.stdout
    assert "both axes are idle" in done.stdout
    assert not procfs.fleet_pids(run_dir)
    assert not run_dir.exists()


def test_on_the_emulated_robot_an_interrupt_and_a_service_stop_it(
    run_dir: Path, robot: RobotConfig
) -> None:
    with started(run_dir, "simulator", "ankle_left"):
        process = subprocess.Popen(
            command("drive", "jog", *LEG, "--cycles", "20", "--run-dir", run_dir),
            cwd=CHECKOUT,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        assert process.stdout is not None
        for line in process.stdout:
            if "reference" in line and "1." in line.split(" s ")[0]:
                break
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 130, output
        assert "stopped by SIGINT" in output
        assert "both axes are idle" in output
        drive = open_drive(robot, MODULE, run_dir)
        statuses = {reading.status for _ in range(300) if (reading := drive.read(0.01))}
        drive.close()
        assert DriveStatus.IDLE in statuses
        assert DriveStatus.ARMED not in statuses
        for words, why in ((("ankle_left", "--yes"), "its joint service"), ((MODULE,), "--yes")):
            refused = xrl("drive", "jog", *words, run_dir=run_dir)
            assert refused.returncode == 2
            assert why in refused.stderr


def test_a_small_limit_stops_it_and_the_doctor_then_finds_the_drive_as_it_was(
    run_dir: Path,
) -> None:
    """Its limits too: `drive configure --apply` would restart the board for them, zero and all."""
    with started(run_dir, "simulator"):
        weak = xrl("drive", "jog", MODULE, "--torque-limit", "4", "--yes", run_dir=run_dir)
        assert weak.returncode == 3, weak.stdout + weak.stderr
        assert "torque limit of 4 N m" in weak.stdout
        assert "both axes are idle" in weak.stdout
        report = json.loads(xrl("doctor", "--json", run_dir=run_dir).stdout)
    rows = [row for group in report["groups"].values() for row in group]
    assert [row for row in rows if row["verdict"] == "wrong"] == []
    assert sum(row["what"] == "settings" for row in rows) == len(MODULES)
