"""`xrl drive zero` and `xrl drive jog` on the emulated robot, as a person types them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import can
import msgspec
import pytest

from services.joint.__main__ import open_drive
from services.joint.drivers.base import DriveStatus
from shared.bus import topics
from shared.bus.messages import JointState, Mode, SimTruth
from shared.bus.session import open_session
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.config.robot_config import RobotConfig, expand
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tests.system.verbs import xrl
from tools.bringup import bench, zeroing
from tools.bringup.zeroing import DriveLook, look
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

ROOT = DEFAULT_CONFIG.parents[1]
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
            seen = look(drive, robot.drive.zero_mark_turns, robot.joint.gear_ratio)
            if seen.zeroed == zeroed and seen.status is not DriveStatus.LOST:
                return seen
            assert time.monotonic() < deadline, seen
    finally:
        drive.close()


def torso_height(robot: RobotConfig, run_dir: Path) -> float:
    """Return how high the emulated robot hangs, once it hangs still, m above the ankles."""
    with open_session(robot, "test", run_dir) as session:
        truths = session.latest(topics.SIM_TRUTH, SimTruth)
        until = time.monotonic() + bench.SETTLE_S
        newest: SimTruth | None = None
        while newest is None or time.monotonic() < until:
            newest = truths.take() or newest
            time.sleep(0.01)
        return newest.torso[2]


def wait_for_mode(robot: RobotConfig, run_dir: Path, module: str, mode: Mode) -> None:
    with open_session(robot, "test", run_dir) as session:
        states = session.latest(topics.JOINT_STATE, JointState, module)
        deadline = time.monotonic() + 30.0
        newest: JointState | None = None
        while newest is None or newest.mode != mode:
            newest = states.take() or newest
            assert time.monotonic() < deadline, newest
            time.sleep(0.01)


def test_emulated_drives_are_zeroed_by_a_protractor_and_by_the_stand(
    run_dir: Path, robot: RobotConfig
) -> None:
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator"])
    try:
        height = torso_height(robot, run_dir)
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
    finally:
        fleet.stop()


def test_beside_its_joint_service_a_module_is_zeroed_only_while_that_is_disarmed(
    run_dir: Path, robot: RobotConfig
) -> None:
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator", MODULE])
    order = ("drive", "zero", MODULE, "--at", "0.03,-1.0", "--yes")
    try:
        wait_for_mode(robot, run_dir, MODULE, Mode.HOLD)
        held = xrl(*order, run_dir=run_dir)
        assert held.returncode == 2
        assert "holds it (HOLD)" in held.stderr
        lose_power(robot, run_dir, MODULE)
        wait_for_mode(robot, run_dir, MODULE, Mode.FAULT)
        faulty = xrl(*order, run_dir=run_dir)
        assert faulty.returncode == 2
        assert f"xrl kill {MODULE}" in faulty.stderr
        fleet.kill(MODULE)
        wait_for_mode(robot, run_dir, MODULE, Mode.DISARMED)
        eventually_look(robot, run_dir, MODULE, zeroed=False)
        done = xrl(*order, run_dir=run_dir)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "arms the drive as soon as it is zeroed" in " ".join(done.stdout.split())
        wait_for_mode(robot, run_dir, MODULE, Mode.HOLD)
    finally:
        fleet.stop()


def test_a_leg_of_the_emulated_robot_follows_and_nothing_is_left_behind(run_dir: Path) -> None:
    done = xrl("drive", "jog", *LEG, "--cycles", "1", run_dir=run_dir)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "FOLLOWED" in done.stdout
    assert "both axes are idle" in done.stdout
    assert not procfs.fleet_pids(run_dir)
    assert not run_dir.exists()


def test_after_a_jog_the_doctor_finds_the_drive_as_it_was(run_dir: Path) -> None:
    """Its limits too: `xrl drive configure --apply` would restart the board for them."""
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator"])
    try:
        jogged = xrl("drive", "jog", MODULE, "--torque-limit", "4", "--yes", run_dir=run_dir)
        assert "both axes are idle" in jogged.stdout, jogged.stdout + jogged.stderr
        report = json.loads(xrl("doctor", "--json", run_dir=run_dir).stdout)
    finally:
        fleet.stop()
    rows = [row for group in report["groups"].values() for row in group]
    assert [row for row in rows if row["verdict"] == "wrong"] == []
    assert sum(row["what"] == "settings" for row in rows) == len(MODULES)


def test_on_the_emulated_robot_a_small_limit_an_interrupt_and_a_service_stop_it(
    run_dir: Path, robot: RobotConfig
) -> None:
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator", "ankle_left"])
    try:
        weak = xrl("drive", "jog", MODULE, "--torque-limit", "4", "--yes", run_dir=run_dir)
        assert weak.returncode == 3, weak.stdout + weak.stderr
        assert "torque limit of 4 N m" in weak.stdout
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "tools.cli", "drive", "jog", *LEG, "--cycles", "20"),
                *("--run-dir", str(run_dir)),
            ],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        assert process.stdout is not None
        for line in process.stdout:
            if "asked" in line and "1." in line.split(" s ")[0]:
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
        held = xrl("drive", "jog", "ankle_left", "--yes", run_dir=run_dir)
        assert held.returncode == 2
        assert "its joint service" in held.stderr
        unasked = xrl("drive", "jog", MODULE, run_dir=run_dir)
        assert unasked.returncode == 2
        assert "--yes" in unasked.stderr
    finally:
        fleet.stop()
