"""A service that was frozen goes on from what its drive carries (docs/drives.md)."""

from __future__ import annotations

from typing import Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drive_manager import (
    GAP_NS,
    LISTEN_NS,
    DriveAction,
    DriveCommand,
    DriveManager,
    DriveManagerState,
)
from services.joint.drivers.base import DriveReading, DriveStatus, MotorTarget
from shared.bus.messages import JointCommand, Mode, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import T0, command, with_service

LoopName = Literal["onboard", "service"]


class Bench:
    """A module and its drive: the drive goes on with what it was told last."""

    def __init__(self, robot: RobotConfig, loop: LoopName, module: str = "knee_right") -> None:
        self.robot = with_service(robot, loop=loop)
        self.module = DriveManager(self.robot, module)
        self.cycle_ns = round(NS_PER_S / robot.joint_service.rate_hz)
        self.now_ns = T0
        self.q: Pair = (0.02, -1.0)
        self.v: Pair = (0.0, 0.0)
        self.status = DriveStatus.IDLE
        self.target: MotorTarget | None = None
        self.torque: Pair = (0.0, 0.0)
        self.seq = 0

    @property
    def mode(self) -> Mode:
        return self.module.controller.failsafe.mode

    def carried(self) -> Pair:
        """Return the joint torques that the drive gives now, N m, by the firmware's law."""
        ratio = self.robot.joint.gear_ratio
        if self.target is None:
            return joint_torque(self.torque, ratio)
        t, motors = self.target, []
        pos, vel = motor_from_joint(self.q, ratio), motor_from_joint(self.v, ratio)
        for i in (0, 1):
            wanted = t.vel_turns[i] + t.pos_gain[i] * (t.pos_turns[i] - pos[i])
            motors.append(t.torque[i] + t.vel_gain[i] * (wanted - vel[i]))
        return joint_torque((motors[0], motors[1]), ratio)

    def cycle(
        self, sent: JointCommand | None = None, *, estop: bool = False, silent: bool = False
    ) -> DriveAction:
        """Run a cycle, and have the drive do what it orders."""
        self.now_ns += self.cycle_ns
        ratio = self.robot.joint.gear_ratio
        pos, vel = motor_from_joint(self.q, ratio), motor_from_joint(self.v, ratio)
        reading = DriveReading(self.now_ns, pos, vel, self.status, 0)
        step = self.module.step(self.now_ns, None if silent else reading, sent, estop)
        if step.command is DriveCommand.ARM:
            self.status = DriveStatus.ARMED
        elif step.command is DriveCommand.TARGET:
            self.target = step.target
        elif step.command is DriveCommand.TORQUE:
            self.torque = step.torque
        return step

    def track(self, cycles: int) -> None:
        for _ in range(cycles):
            self.seq += 1
            self.cycle(command(seq=self.seq, echo_t_ns=self.now_ns, tau_coupled=(3.0, -4.0)))

    def to(self, mode: Mode) -> None:
        while self.mode is not Mode.HOLD:
            self.cycle()
        if mode in (Mode.TRACK, Mode.DAMP):
            self.track(2000)
        if mode is Mode.DAMP:
            self.cycle(estop=True)
        for _ in range(40):
            self.track(1) if mode is Mode.TRACK else self.cycle()
        assert self.mode is mode

    def freeze(self, lasting_ns: int, q: Pair, v: Pair = (0.0, 0.0)) -> None:
        """Run no cycle for a while; the joint is then somewhere else."""
        self.now_ns += lasting_ns
        self.q, self.v = q, v


MODES = (Mode.HOLD, Mode.TRACK, Mode.DAMP)
LOOPS: tuple[LoopName, ...] = ("onboard", "service")
MOVED: Pair = (0.05, -0.97)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("loop", LOOPS)
def test_after_a_freeze_the_drives_torque_goes_on_without_a_step(
    robot: RobotConfig, mode: Mode, loop: LoopName
) -> None:
    bench = Bench(robot, loop)
    bench.to(mode)
    bench.freeze(2 * NS_PER_S, MOVED)
    last = bench.carried()
    orders = []
    for _ in range(round(robot.joint_service.blend_ms * NS_PER_MS / bench.cycle_ns) + 30):
        orders.append(bench.cycle().command)
        now = bench.carried()
        assert max(abs(b - a) for a, b in zip(last, now, strict=True)) < 0.6
        last = now
    listening = round(LISTEN_NS / bench.cycle_ns)
    assert orders[:listening] == [DriveCommand.NOTHING] * listening, (
        "what the link has queued is old"
    )
    assert DriveCommand.NOTHING not in orders[listening:]


@pytest.mark.parametrize("loop", LOOPS)
def test_in_the_end_it_holds_as_if_it_had_never_been_frozen(
    robot: RobotConfig, loop: LoopName
) -> None:
    frozen, twin = Bench(robot, loop), Bench(robot, loop)
    for bench in (frozen, twin):
        bench.to(Mode.TRACK)
    frozen.freeze(NS_PER_S, MOVED)
    for share in (0.25, 0.5, 0.75, 1.0):  # a joint moves, and does not jump
        twin.q = tuple(a + share * (b - a) for a, b in zip((0.02, -1.0), MOVED, strict=True))
        twin.cycle()
    for _ in range(700):
        frozen.cycle()
        twin.cycle()
    assert frozen.mode is twin.mode is Mode.HOLD
    assert frozen.carried() == pytest.approx(twin.carried(), abs=1e-9)


def test_a_gap_within_the_age_rule_goes_on_in_track_without_a_step(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.TRACK)
    bench.freeze(GAP_NS + NS_PER_MS, (0.03, -0.98))
    carried = bench.carried()
    for _ in range(20):
        bench.track(1)
        assert bench.carried() == pytest.approx(carried, abs=2.0)
    assert bench.mode is Mode.TRACK


def test_shorter_gaps_are_no_freeze(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    bench.freeze(GAP_NS - bench.cycle_ns, bench.q)
    assert bench.cycle().command is DriveCommand.TARGET


def test_it_sends_nothing_before_the_drive_has_sent(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    bench.freeze(NS_PER_S, MOVED)
    silent = [bench.cycle(silent=True).command for _ in range(20)]
    assert silent == [DriveCommand.NOTHING] * 20
    before = bench.carried()
    assert bench.cycle().command is DriveCommand.TARGET
    assert bench.carried() == pytest.approx(before, abs=1e-6)


def test_a_drive_that_disarmed_meanwhile_is_a_fault_at_once(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    bench.freeze(NS_PER_S, MOVED)
    bench.status = DriveStatus.IDLE
    assert bench.cycle().command is DriveCommand.IDLE
    assert bench.mode is Mode.FAULT


def test_an_emergency_stop_that_came_meanwhile_is_obeyed(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    bench.freeze(NS_PER_S, MOVED)
    before = bench.carried()
    bench.cycle(estop=True)
    assert bench.mode is Mode.DAMP
    for _ in range(10):
        bench.cycle()
    assert bench.carried() == pytest.approx(before, abs=5.0)


@given(st.integers(0, 60), st.tuples(st.floats(-0.05, 0.09), st.floats(-1.1, -0.9)))
def test_a_memory_taken_while_it_goes_on_is_gone_on_with_bit_for_bit(
    robot: RobotConfig, cycles: int, moved: Pair
) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    bench.freeze(NS_PER_S, moved)
    for _ in range(cycles):
        bench.cycle()
    text = msgspec.json.encode(bench.module.snapshot())
    twin = DriveManager(bench.robot, "knee_right")
    twin.restore(msgspec.json.decode(text, type=DriveManagerState))
    ratio = robot.joint.gear_ratio
    for _ in range(30):
        now = bench.now_ns + bench.cycle_ns
        pos, vel = motor_from_joint(bench.q, ratio), motor_from_joint(bench.v, ratio)
        reading = DriveReading(now, pos, vel, bench.status, 0)
        assert bench.cycle() == twin.step(now, reading, None, estop=False)


@pytest.mark.parametrize("loop", LOOPS)
def test_what_the_link_kept_from_before_the_freeze_does_not_make_the_joint_seem_to_jump(
    robot: RobotConfig, loop: LoopName
) -> None:
    """The first sample is of the time before, the next is where the hand has led the joint."""
    bench = Bench(robot, loop)
    bench.to(Mode.HOLD)
    bench.now_ns += 3 * NS_PER_S
    bench.cycle()
    bench.q = (0.02, -1.1)
    for _ in range(100):
        bench.cycle()
    assert bench.mode is Mode.HOLD
    assert bench.module.controller.samples.q == pytest.approx(bench.q)


def test_a_jump_without_a_freeze_is_not_believed(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    bench.q = (0.02, -1.1)
    for _ in range(5):
        bench.cycle()
    assert bench.mode is Mode.FAULT
