"""The emergency stop by shared memory: joint services and simulator, and nothing else alive."""

from __future__ import annotations

import os
import pty
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from services.joint.neighbours import Neighbours
from services.joint.rearm_guard import PENDANT, Pendant, stop_source
from shared.bus import topics
from shared.bus.messages import JointState, Mode, SimTruth
from shared.bus.session import Latest, open_session
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tests.system.verbs import xrl
from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

ROOT = DEFAULT_CONFIG.parents[1]


def wait_for_modes(robot: RobotConfig, run_dir: Path, wanted: dict[str, Mode]) -> None:
    """Wait until each module tells its mode."""
    with open_session(robot, "test", run_dir) as session:
        states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        modes: dict[str, int] = {}
        deadline = time.monotonic() + 40.0
        while {module: modes.get(module) for module in wanted} != wanted:
            assert time.monotonic() < deadline, (modes, wanted)
            for module, latest in states.items():
                state = latest.take()
                if state is not None:
                    modes[module] = state.mode
            time.sleep(0.01)


def wait_until_all(states: dict[str, Latest[JointState]], wanted: Mode) -> None:
    """Wait until every module that this open session hears tells a mode, from now on."""
    modes: dict[str, int] = {}
    deadline = time.monotonic() + 40.0
    while [modes.get(module) for module in MODULES] != [wanted] * len(MODULES):
        assert time.monotonic() < deadline, modes
        for module, latest in states.items():
            if (state := latest.take()) is not None:
                modes[module] = state.mode
        time.sleep(0.01)


def wait_for_beats(run_dir: Path) -> None:
    """Wait until each module has heard a pendant for a while."""
    pendant, deadline = Pendant(run_dir, MODULES), time.monotonic() + 40.0
    while min(pendant.beats) < 20:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def truth(robot: RobotConfig, run_dir: Path, wait_s: float = 0.0) -> SimTruth:
    """Return the world after a while."""
    with open_session(robot, "test", run_dir) as session:
        truths = session.latest(topics.SIM_TRUTH, SimTruth)
        until = time.monotonic() + wait_s
        newest: SimTruth | None = None
        while newest is None or time.monotonic() < until:
            newest = truths.take() or newest
            time.sleep(0.01)
        return newest


def test_with_planner_and_bus_dead_it_sinks_by_shared_memory(
    run_dir: Path, robot: RobotConfig
) -> None:
    """`--local` opens no session: of the bus nothing is used. Asked for anew, a module waits."""
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator", *MODULES])
    try:
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES, Mode.HOLD))
        done = xrl("estop", "--local", run_dir=run_dir)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "all six modules are stopped" in done.stdout
        assert {Neighbours.mode_of(run_dir, module) for module in MODULES} == {Mode.DAMP}
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES, Mode.DAMP))
        assert all("xrl estop by" in stop_source(run_dir, module) for module in MODULES)
        before, after = truth(robot, run_dir), truth(robot, run_dir, wait_s=6.0)
        assert not after.fallen
        assert after.torso[2] < before.torso[2] - 0.05, "it sinks"
        assert abs(after.angles[1]) < 0.1, "and the hips know of their legs"
        assert xrl("kill", "hip_left", run_dir=run_dir).returncode == 0
        others = {module: Mode.DAMP for module in MODULES if module != "hip_left"}
        waiting = Mode.DISARMED  # its drive holds, and is taken over once a planner is heard
        wait_for_modes(robot, run_dir, others | {"hip_left": waiting})
    finally:
        fleet.stop()


def test_a_pendant_that_is_killed_stops_all_six_without_a_planner(
    run_dir: Path, robot: RobotConfig
) -> None:
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator", *MODULES])
    command = [sys.executable, "-m", "tools.cli", "pendant", "--run-dir", str(run_dir)]
    try:
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES, Mode.HOLD))
        with subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE
        ) as held:
            try:
                wait_for_beats(run_dir)
                assert {Neighbours.mode_of(run_dir, module) for module in MODULES} == {Mode.HOLD}
            finally:
                held.kill()
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES, Mode.DAMP))
        said = xrl("status", run_dir=run_dir).stdout
        assert f"emergency stop by {PENDANT}: {', '.join(MODULES)}" in " ".join(said.split())
    finally:
        fleet.stop()


@pytest.mark.parametrize("disaster", ["hung", "dead, disk full", "dead, directory gone"])
def test_it_needs_no_supervisor(disaster: str, run_dir: Path, robot: RobotConfig) -> None:
    """The services hold on without it, and hear both ways, or else a signal."""
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator", *MODULES])
    supervisor = int(fleet.run.supervisor_pid.read_text(encoding="utf-8"))
    try:
        with open_session(robot, "test", run_dir) as session:
            states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
            wait_until_all(states, Mode.HOLD)
            if disaster == "hung":
                os.kill(supervisor, signal.SIGSTOP)
            else:
                for log in fleet.run.logs.iterdir():
                    log.unlink()
                    log.symlink_to("/dev/full")
                os.kill(supervisor, signal.SIGKILL)
            if disaster.endswith("gone"):
                shutil.rmtree(run_dir)
            pids = fleet.pids()
            time.sleep(1.0)
            assert fleet.pids() == pids, "every service goes on"
            wait_until_all(states, Mode.HOLD)
            done = xrl("estop", run_dir=run_dir)
            gone = disaster.endswith("gone")
            assert ("unconfirmed" in done.stderr) == gone, done.stderr
            assert done.returncode == (2 if gone else 0), done.stdout + done.stderr
            wait_until_all(states, Mode.DAMP)
    finally:
        os.kill(supervisor, signal.SIGCONT)
        fleet.stop()
    assert procfs.fleet_pids(run_dir) == set()


@pytest.mark.parametrize(("typed", "ends_in"), [(b"q\n", Mode.HOLD), (b"\n", Mode.DAMP)])
def test_one_that_waits_says_whom_it_hears_and_stops_at_enter_but_not_at_q(
    typed: bytes, ends_in: Mode, run_dir: Path, robot: RobotConfig
) -> None:
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator", *MODULES])
    person, terminal = pty.openpty()
    command = [sys.executable, "-u", "-m", "tools.cli", "estop", "--wait", "--run-dir"]
    try:
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES, Mode.HOLD))
        with subprocess.Popen(
            [*command, str(run_dir)], cwd=ROOT, stdin=terminal, stdout=subprocess.PIPE, text=True
        ) as waiting:
            try:
                assert waiting.stdout is not None
                told = iter(waiting.stdout.readline, "")
                assert any("all six heard" in line for line in told)
                os.write(person, typed)
                assert waiting.wait(timeout=40.0) == 0
            finally:
                waiting.kill()
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES, ends_in))
    finally:
        fleet.stop()
        os.close(person)
        os.close(terminal)


def test_a_module_without_a_service_here_is_named(run_dir: Path, robot: RobotConfig) -> None:
    fleet = SupervisedFleet.start(DEFAULT_CONFIG, run_dir, services=["simulator", *MODULES[:5]])
    try:
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES[:5], Mode.HOLD))
        done = xrl("estop", "--local", run_dir=run_dir)
        assert done.returncode == 2
        assert f"{MODULES[5]} has no service on this host" in done.stderr
        wait_for_modes(robot, run_dir, dict.fromkeys(MODULES[:5], Mode.DAMP))
    finally:
        fleet.stop()
