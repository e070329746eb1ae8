"""The emergency stop by shared memory: joint services and simulator, and nothing else alive."""

from __future__ import annotations

import os
import pty
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.joint.neighbours import Neighbours
from services.joint.rearm_guard import PENDANT, Pendant, stop_source
from shared.bus import topics
from shared.bus.messages import HandLead, Mode
from shared.bus.session import open_session
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import CHECKOUT
from tests.messages import sample
from tests.system.fleets import FleetEar, command, heard, started, wait_for, xrl
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]


@pytest.fixture
def fleet(run_dir: Path) -> Iterator[SupervisedFleet]:
    with started(run_dir, "simulator", *MODULES) as up:
        yield up


@pytest.fixture
def ear(fleet: SupervisedFleet, robot: RobotConfig) -> Iterator[FleetEar]:
    """Hear six modules that hold."""
    with heard(robot, fleet.run.path) as ear:
        ear.wait_for(Mode.HOLD)
        yield ear


def wait_and_type(run_dir: Path, typed: bytes) -> None:
    """Run `xrl estop --wait` until it hears all six, type, and await its end."""
    person, terminal = pty.openpty()
    words = [sys.executable, "-u", *command("estop", "--wait", "--run-dir", run_dir)[1:]]
    try:
        with subprocess.Popen(
            words, cwd=CHECKOUT, stdin=terminal, stdout=subprocess.PIPE, text=True
        ) as waiting:
            try:
                assert waiting.stdout is not None
                told = iter(waiting.stdout.readline, "")
                assert any("all six modules respond" in line for line in told)
                os.write(person, typed)
                assert waiting.wait(timeout=40.0) == 0
            finally:
                waiting.kill()
    finally:
        os.close(person)
        os.close(terminal)


def test_with_planner_and_bus_dead_it_sinks_by_shared_memory(ear: FleetEar, run_dir: Path) -> None:
    """`--local` opens no session: of the bus nothing is used. Asked for again, a module waits.

    One that waits for Enter, and is left by another key, stops nothing.
    """
    wait_and_type(run_dir, b"q\n")
    ear.wait_for(Mode.HOLD)
    done = xrl("estop", "--local", run_dir=run_dir)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "stopped (DAMP): all six modules" in done.stdout
    assert {Neighbours.mode_of(run_dir, module) for module in MODULES} == {Mode.DAMP}
    ear.wait_for(Mode.DAMP)
    assert all("xrl estop by" in stop_source(run_dir, module) for module in MODULES)
    before = ear.world().torso[2]
    assert wait_for(lambda: ear.world(after_s=0.1).torso[2] < before - 0.05), "it sinks"
    after = ear.world()
    assert not after.fallen
    assert abs(after.angles[1]) < 0.1, "and the hips know of their legs"
    assert xrl("kill", "hip_left", run_dir=run_dir).returncode == 0
    waiting = Mode.DISARMED  # its drive holds, and is taken over once a planner is heard
    ear.wait_for(dict.fromkeys(MODULES, Mode.DAMP) | {"hip_left": waiting})


def test_a_pendant_that_is_killed_stops_all_six_without_a_planner(
    ear: FleetEar, run_dir: Path
) -> None:
    words = command("pendant", "--run-dir", run_dir)
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    with subprocess.Popen(words, cwd=CHECKOUT, **quiet) as held:
        try:
            beats = Pendant(run_dir, MODULES)
            assert wait_for(lambda: min(beats.beats) >= 20, timeout_s=40.0)
            assert {Neighbours.mode_of(run_dir, module) for module in MODULES} == {Mode.HOLD}
        finally:
            held.kill()
    ear.wait_for(Mode.DAMP)
    said = xrl("status", run_dir=run_dir).stdout
    assert f"emergency stop by {PENDANT}: {', '.join(MODULES)}" in " ".join(said.split())


def test_after_a_stop_all_six_are_rearmed_together_once_it_rests_and_nobody_pulls(
    robot: RobotConfig, run_dir: Path
) -> None:
    """After `xrl kill` of one module that one held while five sank."""
    services = ("simulator", "harness", "planner", *MODULES)
    with started(run_dir, *services) as fleet, open_session(robot, "test", run_dir) as session:
        ear = FleetEar(session)
        hands = session.publisher(topics.OPERATOR_HAND, HandLead)
        ear.wait_until_led()
        before = fleet.pids()
        assert xrl("estop", run_dir=run_dir).returncode == 0
        assert "xrl rearm" in xrl("status", run_dir=run_dir).stdout
        assert wait_for(lambda: ear.world(after_s=0.1).torso[2] < 0.95), "it sinks"
        refused = xrl("rearm", run_dir=run_dir)
        assert refused.returncode == 2
        assert "nothing was re-armed" in refused.stderr
        assert fleet.pids() == before, "none of the six"

        def hand_is_off() -> bool:
            torso, pitch = ear.world(after_s=0.05).torso[2], ear.world().angles[1]
            hands.put(
                sample(
                    HandLead, t_ns=now_ns(), leads=True, height=torso, pitch=pitch, push=(0, 0, 0)
                )
            )
            return xrl("rearm", run_dir=run_dir).returncode == 0

        assert wait_for(hand_is_off), "the hand goes where the robot is"
        now = fleet.pids()
        assert all(now[name] != before[name] for name in MODULES)
        assert {ear.modes()[name] for name in MODULES} <= {Mode.HOLD, Mode.TRACK}
        assert not ear.fell


@pytest.mark.parametrize("disaster", ["hung", "dead, directory gone"])
def test_it_needs_no_supervisor(
    disaster: str, fleet: SupervisedFleet, ear: FleetEar, run_dir: Path
) -> None:
    """The services hold on without it, and hear both ways, or else a signal.

    Where it is hung, somebody waits and presses Enter; where it is dead, the disk is full too.
    """
    supervisor = int(fleet.run.supervisor_pid.read_text(encoding="utf-8"))
    gone = disaster.endswith("gone")
    try:
        if disaster == "hung":
            os.kill(supervisor, signal.SIGSTOP)
        else:
            for log in fleet.run.logs.iterdir():
                log.unlink()
                log.symlink_to("/dev/full")
            os.kill(supervisor, signal.SIGKILL)
        if gone:
            shutil.rmtree(run_dir)
            shutil.rmtree(fleet.run.live)
        pids = fleet.pids()
        ear.world(after_s=1.0)
        assert fleet.pids() == pids, "every service goes on"
        ear.wait_for(Mode.HOLD)
        if gone:
            done = xrl("estop", run_dir=run_dir)
            assert done.returncode == 2, done.stdout + done.stderr
            assert "unconfirmed" in done.stderr
        else:
            wait_and_type(run_dir, b"\n")
        ear.wait_for(Mode.DAMP)
    finally:
        os.kill(supervisor, signal.SIGCONT)
        fleet.stop()
    assert procfs.fleet_pids(run_dir) == set()
