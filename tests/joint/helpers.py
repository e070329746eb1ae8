"""A module's controller on a bench: virtual time, a drive that answers, a planner's commands."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from services.joint.controller import CycleResult, JointController
from services.joint.differential import motor_from_joint
from services.joint.drivers.base import DriveReading, DriveStatus
from services.joint.neighbours import UNKNOWN, NeighbourView
from shared.bus.messages import JointCommand, Mode, Pair
from shared.clock import NS_PER_S
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig

T0 = 1_000 * NS_PER_S
SESSION = 7


def command(**changes: Any) -> JointCommand:
    """Return a command within every limit, with some fields changed."""
    fields: dict[str, Any] = {
        "t_ns": T0,
        "seq": 1,
        "session": SESSION,
        "echo_t_ns": T0,
        "hold": False,
        "q_ref": (0.02, -1.0),
        "v_ref": (0.0, 0.0),
        "tau_ff": (3.0, -25.0),
        "dtau_ff": (0.0, 0.0),
        "tau_coupled": (0.0, 0.0),
        "k_p": (600.0, 800.0),
        "k_d": (40.0, 50.0),
        "margin": 1.0,
        "margin_onboard": 0.5,
    }
    return JointCommand(**(fields | changes))


def with_service(robot: RobotConfig, **changes: Any) -> RobotConfig:
    """Return the robot with some keys of [joint_service] changed."""
    service = msgspec.structs.replace(robot.joint_service, **changes)
    return msgspec.structs.replace(robot, joint_service=service)


class Bench:
    """One controller, cycled at its rate; the joint stays where it is put."""

    def __init__(self, robot: RobotConfig, module: str = "knee_right") -> None:
        self.controller = JointController(believing(robot), module)
        self.gear_ratio = robot.joint.gear_ratio
        self.cycle_ns = round(NS_PER_S / robot.joint_service.rate_hz)
        self.now_ns = T0
        self.q: Pair = (0.02, -1.0)
        self.v: Pair = (0.0, 0.0)
        self.status = DriveStatus.ARMED
        self.seq = 0

    @property
    def mode(self) -> Mode:
        """Return the mode the controller is in."""
        return self.controller.failsafe.mode

    def reading(self) -> DriveReading:
        """Return what the drive measures."""
        pos = motor_from_joint(self.q, self.gear_ratio)
        vel = motor_from_joint(self.v, self.gear_ratio)
        return DriveReading(self.now_ns, pos, vel, self.status, 0)

    def fresh(self, **changes: Any) -> JointCommand:
        """Return the next command, echoing the state of the cycle before."""
        self.seq += 1
        return command(**({"seq": self.seq, "echo_t_ns": self.now_ns} | changes))

    def cycle(
        self,
        sent: JointCommand | None = None,
        *,
        estop: bool = False,
        stalled: bool = False,
        after_ns: int = 0,
        near: NeighbourView = UNKNOWN,
    ) -> CycleResult:
        """Run the next cycle: a period, or `after_ns`, after the one before."""
        self.now_ns += after_ns or self.cycle_ns
        reading = None if stalled else self.reading()
        return self.controller.step(self.now_ns, reading, sent, estop, near=near)

    def run(self, cycles: int, *, fresh: bool = False, **changes: Any) -> list[CycleResult]:
        """Run cycles, with a fresh command in each or with none."""
        return [self.cycle(self.fresh(**changes) if fresh else None) for _ in range(cycles)]

    def move(self, q: Pair) -> None:
        """Move the joint as a joint may: 0.01 rad a cycle."""
        steps = math.ceil(max(abs(b - a) for a, b in zip(self.q, q, strict=True)) / 0.01)
        start = self.q
        for step in range(1, steps + 1):
            share = step / steps
            self.q = (
                start[0] + share * (q[0] - start[0]),
                start[1] + share * (q[1] - start[1]),
            )
            self.cycle()

    def to_hold(self) -> None:
        """Arm the drive: HOLD at the measured pose."""
        self.cycle()
        assert self.mode is Mode.HOLD

    def to_track(self, **changes: Any) -> None:
        """Send fresh commands until TRACK has blended in fully."""
        self.to_hold()
        for _ in range(2000):
            self.cycle(self.fresh(**changes))
            if self.mode is Mode.TRACK:
                break
        assert self.mode is Mode.TRACK
        self.run(400, fresh=True, **changes)

    def to(self, mode: Mode) -> None:
        """Bring the controller into a mode by what brings it there on the robot."""
        if mode is Mode.DISARMED:
            self.status = DriveStatus.IDLE
            self.cycle()
        elif mode is Mode.HOLD:
            self.to_hold()
        else:
            self.to_track()
        if mode is Mode.DAMP:
            self.cycle(estop=True)
        if mode is Mode.FAULT:
            self.status = DriveStatus.LOST
            self.cycle()
        assert self.mode is mode
