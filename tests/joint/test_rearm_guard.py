"""What a joint service leaves to its successor: nothing takes hold again unless it is asked to."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from services.joint import loop as joint_loop
from services.joint import rearm_guard as wills
from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drive_manager import (
    ARM_EVERY_NS,
    ArmingInhibit,
    DriveAction,
    DriveCommand,
    DriveManager,
)
from services.joint.drivers.base import DriveReading, DriveStatus
from services.joint.loop import JointLoop
from services.joint.rearm_guard import LastState, Pendant, RearmGuard
from shared.bus.messages import JointCommand, Mode, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.joint.helpers import T0, command
from tests.joint.test_loop import Rig, Stop

MODULE = "knee_right"
Q: Pair = (0.02, -1.0)
CARRIED: Pair = (0.3, 1.4)
"""Motor torques that a drive found armed tells, N m."""


class Successor:
    """A module's service after one that has left a will, and the drive that it finds."""

    def __init__(self, robot: RobotConfig, last_state: LastState, status: DriveStatus) -> None:
        assert robot.joint_service.loop == "onboard"
        self.module = DriveManager(robot, MODULE, last_state)
        self.ratio = robot.joint.gear_ratio
        self.cycle_ns = round(NS_PER_S / robot.joint_service.rate_hz)
        self.now_ns = T0
        self.status = status
        self.carries: Pair | None = None
        self.seq = 0

    @property
    def mode(self) -> Mode:
        return self.module.controller.failsafe.mode

    def cycle(
        self, sent: JointCommand | None = None, *, estop: bool = False, silent: bool = False
    ) -> DriveAction:
        self.now_ns += self.cycle_ns
        pos = motor_from_joint(Q, self.ratio)
        reading = DriveReading(self.now_ns, pos, (0.0, 0.0), self.status, 0, self.carries)
        return self.module.step(self.now_ns, None if silent else reading, sent, estop)

    def lead(self, **changes: Any) -> DriveAction:
        """Run a cycle with a usable command."""
        self.seq += 1
        return self.cycle(command(seq=self.seq, echo_t_ns=self.now_ns, **changes))

    def run(self, lasting_ns: int) -> list[DriveAction]:
        return [self.cycle() for _ in range(lasting_ns // self.cycle_ns)]


def test_the_first_service_leaves_what_it_does(robot: RobotConfig) -> None:
    service = Successor(robot, LastState.NOTHING, DriveStatus.IDLE)
    left = [service.module.last_state]
    assert service.cycle().command is DriveCommand.ARM
    left.append(service.module.last_state)  # asked for, but it may not come to hold
    service.status = DriveStatus.ARMED
    service.cycle()
    left.append(service.module.last_state)
    for _ in range(200):
        service.lead()
    assert service.mode is Mode.TRACK
    left.append(service.module.last_state)
    service.cycle(estop=True)
    left.append(service.module.last_state)
    service.status = DriveStatus.ERROR
    service.cycle()
    assert service.mode is Mode.FAULT
    left.append(service.module.last_state)
    assert left == [
        LastState.NOTHING,
        LastState.NOTHING,
        LastState.HELD,
        LastState.HELD,
        LastState.DAMP,
        LastState.DAMP,
    ]


def test_a_fault_of_a_module_that_held_leaves_that_it_held(robot: RobotConfig) -> None:
    service = Successor(robot, LastState.NOTHING, DriveStatus.IDLE)
    service.cycle()
    for status in (DriveStatus.ARMED, DriveStatus.ERROR):
        service.status = status
        service.cycle()
    assert service.mode is Mode.FAULT
    assert service.module.last_state is LastState.HELD


@pytest.mark.parametrize("status", [DriveStatus.IDLE, DriveStatus.ERROR])
@pytest.mark.parametrize("led", [True, False])
def test_a_drive_that_held_and_has_let_go_is_not_armed_by_a_service_that_was_not_asked_for(
    robot: RobotConfig, status: DriveStatus, led: bool
) -> None:
    """The supervisor starts what crashes: it armed under load, with a step of 28 N m."""
    service = Successor(robot, LastState.HELD, status)
    steps = [service.lead() if led else service.cycle() for _ in range(2000)]
    assert {step.command for step in steps} == {DriveCommand.NOTHING}
    assert ArmingInhibit.LOST_TORQUE in {step.inhibit for step in steps}
    assert service.mode is Mode.DISARMED
    assert service.module.last_state is LastState.HELD, "nor by the next"


@pytest.mark.parametrize("status", [DriveStatus.IDLE, DriveStatus.ERROR])
def test_after_an_emergency_stop_a_drive_that_has_let_go_is_not_armed(
    robot: RobotConfig, status: DriveStatus
) -> None:
    service = Successor(robot, LastState.DAMP, status)
    orders = {step.command for step in service.run(2 * NS_PER_S)}
    assert DriveCommand.ARM not in orders
    assert service.module.last_state is LastState.DAMP


@pytest.mark.parametrize("last_state", [LastState.NOTHING, LastState.HELD])
def test_a_drive_that_holds_is_left_alone_until_a_planner_sends(
    robot: RobotConfig, last_state: LastState
) -> None:
    """Taken over with stand gains, beside a knee on soft ones, it tipped the robot."""
    service = Successor(robot, last_state, DriveStatus.ARMED)
    service.carries = CARRIED
    steps = service.run(2 * NS_PER_S)
    assert {step.command for step in steps} == {DriveCommand.NOTHING}
    assert {step.inhibit for step in steps} == {ArmingInhibit.NONE, ArmingInhibit.WAITING}
    assert service.mode is Mode.DISARMED
    assert service.module.controller.state(service.now_ns).drive == DriveStatus.HOLDING
    assert service.module.leaves_holding, "should it end before it has taken the drive over"
    for _ in range(2):
        service.lead(hold=True)
    assert service.mode is Mode.HOLD
    assert service.module.controller.state(service.now_ns).drive == DriveStatus.ARMED


@pytest.mark.parametrize("last_state", [LastState.NOTHING, LastState.HELD])
@pytest.mark.parametrize("k_p", [(600.0, 800.0), (900.0, 12.0)])
def test_it_is_taken_over_with_the_commands_gains_and_the_torque_that_it_carries(
    robot: RobotConfig, last_state: LastState, k_p: Pair
) -> None:
    service = Successor(robot, last_state, DriveStatus.ARMED)
    service.carries = CARRIED
    service.run(100 * NS_PER_MS)
    k_d: Pair = (40.0, 3.0)
    assert service.lead(hold=True, k_p=k_p, k_d=k_d).target is None
    step = service.lead(hold=True, k_p=k_p, k_d=k_d)
    setpoint = service.module.controller.setpoint
    assert (setpoint.k_p, setpoint.k_d) == (k_p, k_d)
    assert setpoint.q_ref == pytest.approx(Q)
    last = joint_torque(CARRIED, service.ratio)
    assert service.module.controller.tau == pytest.approx(last)
    assert step.target is not None
    for _ in range(250):
        service.lead(hold=True, k_p=k_p, k_d=k_d)
        tau = service.module.controller.tau
        assert tau == pytest.approx(last, abs=0.6)
        last = tau
    risen = service.module.controller.setpoint
    assert risen.k_p[1] == k_p[1], "theta of a knee as soft as the other knee's"


@pytest.mark.parametrize("carries", [CARRIED, None])
def test_a_command_does_not_take_over_a_drive_whose_torques_are_not_known(
    robot: RobotConfig, carries: Pair | None
) -> None:
    service = Successor(robot, LastState.HELD, DriveStatus.ARMED)
    service.carries = carries
    for _ in range(100):
        service.lead()
    assert (service.mode is Mode.DISARMED) is (carries is None)


def test_after_an_emergency_stop_a_drive_that_holds_is_taken_over_and_sinks(
    robot: RobotConfig,
) -> None:
    """Without a planner too: in HOLD it would be the one strut while five sink."""
    service = Successor(robot, LastState.DAMP, DriveStatus.ARMED)
    service.carries = CARRIED
    before = joint_torque(CARRIED, service.ratio)
    steps = service.run(20 * NS_PER_MS)
    assert service.mode is Mode.DAMP
    assert steps[0].event is not None
    assert steps[0].event.mode_after == Mode.HOLD, "first it is taken over"
    assert service.module.controller.tau == pytest.approx(before, abs=2.0)
    service.run(round(robot.joint_service.damp_fade_s) * NS_PER_S)
    assert service.module.controller.tau == pytest.approx((before[0], 0.0), abs=1e-6)
    assert service.module.last_state is LastState.DAMP


@pytest.mark.parametrize("unknown", ["silent", "LOST", "HOLDING"])
def test_an_emergency_stop_waits_until_the_drive_is_known(robot: RobotConfig, unknown: str) -> None:
    """A law made of a joint that was never seen would pull it to zero."""
    status = DriveStatus.LOST if unknown == "LOST" else DriveStatus.ARMED
    service = Successor(robot, LastState.NOTHING, status)
    silent = unknown == "silent"
    steps = [service.cycle(estop=True, silent=silent)]
    steps += [service.cycle(silent=silent) for _ in range(100)]
    assert service.mode is Mode.DISARMED
    assert {step.command for step in steps} == {DriveCommand.NOTHING}
    service.status, service.carries = DriveStatus.ARMED, CARRIED
    for _ in range(2):
        service.cycle()
    assert service.mode is Mode.DAMP
    assert service.module.controller.setpoint.q_ref == pytest.approx(Q)
    assert service.module.controller.tau == pytest.approx(
        joint_torque(CARRIED, service.ratio), abs=2.0
    )


def test_zeroing_a_drive_needs_a_request(robot: RobotConfig) -> None:
    service = Successor(robot, LastState.HELD, DriveStatus.UNZEROED)
    assert DriveCommand.ARM not in {step.command for step in service.run(NS_PER_S)}
    service.status = DriveStatus.IDLE
    assert DriveCommand.ARM in {step.command for step in service.run(ARM_EVERY_NS + 10 * NS_PER_MS)}


class Process:
    """A joint service's process over one drive, and the file that outlives it."""

    def __init__(self, robot: RobotConfig, run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.file = RearmGuard(run_dir, MODULE)
        self.rig = Rig(robot, monkeypatch)
        self.module = DriveManager(robot, MODULE, self.file.read())
        ports = self.rig.loop._ports
        self.loop = JointLoop(robot, self.module, self.rig.drive, ports, self.file)
        monkeypatch.setattr(joint_loop, "now_ns", lambda: self.rig.now_ns)

    @property
    def mode(self) -> Mode:
        return self.module.controller.failsafe.mode

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.rig.now_ns += self.rig.period_ns
            self.loop.cycle()

    def end(self, *, interrupted: bool) -> None:
        self.loop.run(cast("Any", Stop(1, interrupted=interrupted)))


@pytest.mark.parametrize(
    ("interrupted", "left"), [(True, LastState.NOTHING), (False, LastState.HELD)]
)
def test_a_fleet_that_goes_down_leaves_nothing_and_a_service_ended_alone_that_it_held(
    robot: RobotConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    interrupted: bool,
    left: LastState,
) -> None:
    process = Process(robot, tmp_path, monkeypatch)
    process.run(10)
    assert RearmGuard(tmp_path, MODULE).read() is LastState.HELD
    process.end(interrupted=interrupted)
    assert RearmGuard(tmp_path, MODULE).read() is left


@pytest.mark.parametrize("asked", [True, False])
def test_a_service_that_crashed_and_is_started_again_arms_only_if_a_person_asked_for_it(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: bool
) -> None:
    dead = Process(robot, tmp_path, monkeypatch)
    dead.run(10)
    assert dead.rig.drive.armed == 1
    if asked:
        wills.clear(tmp_path, MODULE)
    after = Process(robot, tmp_path, monkeypatch)
    after.rig.drive.status = DriveStatus.ERROR  # one axis let go in between
    after.run(1000)
    assert after.rig.drive.armed == int(asked)
    assert RearmGuard(tmp_path, MODULE).read() is LastState.HELD, "it holds, or has held"


def test_a_pendant_that_falls_silent_stops_the_module_and_one_that_was_never_there_does_not(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = Process(robot, tmp_path, monkeypatch)
    silent_cycles = round(robot.joint_service.pendant_ms / 2.0)
    process.run(2 * silent_cycles)
    assert process.mode is Mode.HOLD
    pendant = Pendant(tmp_path, MODULES)
    for _ in range(10):
        pendant.beat()
        process.run(silent_cycles)
    assert process.mode is Mode.HOLD
    process.run(2)
    assert process.mode is Mode.DAMP
    pendant.beat()
    process.run(10)
    assert process.mode is Mode.DAMP, "it does not rise again by itself"


def test_a_pendant_that_is_laid_down_is_not_missed(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = Process(robot, tmp_path, monkeypatch)
    pendant = Pendant(tmp_path, MODULES)
    pendant.beat()
    process.run(10)
    pendant.lay_down()
    process.run(round(robot.joint_service.pendant_ms))
    assert process.mode is Mode.HOLD


def test_a_service_that_starts_anew_misses_the_pendant_of_before(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    RearmGuard(tmp_path, MODULE)
    Pendant(tmp_path, MODULES).beat()
    process = Process(robot, tmp_path, monkeypatch)
    process.run(round(robot.joint_service.pendant_ms))
    assert process.mode is Mode.DAMP
