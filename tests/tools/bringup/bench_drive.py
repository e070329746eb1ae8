"""A drive on a bench in virtual time, with a joint behind it that a test can spoil; its motions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drivers.base import Drive, DriveReading, MotorTarget
from shared.bus.messages import DriveStatus, Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from tools.bringup.motion import AnyPlan, Sample
from tools.bringup.motion_runner import Interrupts, MotionResult, run_motion
from tools.verbs.drive.jog import JogPlan, ThereAndBack

START: Pair = (0.03, -1.0)
STEP_NS = NS_PER_S // 1000
MODULE = "knee_left"
PLAN = JogPlan(axis=1, course=ThereAndBack(0.05, 2.0, 2), torque_limit=10.0)
Progress = Callable[[Sample], None]


def unwatched(_: Sample) -> None:
    """See nothing."""


def jog_by(rad: float) -> JogPlan:
    return PLAN._replace(course=PLAN.course._replace(by=rad))


def move(
    drives: Mapping[str, Drive],
    robot: RobotConfig,
    module: str,
    plan: AnyPlan,
    q_seen: Pair,
    clock: Callable[[], int],
    progress: Progress = unwatched,
    interrupts: Interrupts | None = None,
) -> MotionResult:
    """Return how a motion ended, by the one runner; robot: as of `limit_drives`."""
    return run_motion(
        drives, robot, module, plan, q_seen=q_seen, interrupts=interrupts or Interrupts(),
        progress=progress, clock=clock,
    )  # fmt: skip


class BenchDrive:
    """A module on a bench in virtual time: the firmware's law, inertia and dry friction.

    It has no `write_torque` and no `set_position`: a motion is by the drive's own loop.

    Attributes:
        friction: N m of each axis.
        load: N m that pull on (phi, theta).
        jammed: the joint does not move.
        reversed: the motors push the other way.
        silent_at_s: no word from here on.
        fails_at_s: it disarms with an error.
        deaf: it ignores `idle`.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self.now_ns = NS_PER_S
        self.friction, self.load = 1.0, (0.0, 0.0)
        self.jammed = self.reversed = self.deaf = self.never_arms = False
        self.silent_at_s = self.fails_at_s = math.inf
        self.q, self.v = list(START), [0.0, 0.0]
        self.status = DriveStatus.IDLE
        self.idles = 0
        self.largest = 0.0
        self._drive = robot.drive
        self._ratio = robot.joint.gear_ratio
        self._armed_ns = 0
        self._target: MotorTarget | None = None

    def clock(self) -> int:
        return self.now_ns

    def run(
        self,
        robot: RobotConfig,
        plan: AnyPlan = PLAN,
        *,
        q_seen: Pair = START,
        progress: Progress = unwatched,
        interrupts: Interrupts | None = None,
    ) -> MotionResult:
        """Return how a motion of it alone ended."""
        drives = {MODULE: self}
        return move(drives, robot, MODULE, plan, q_seen, self.clock, progress, interrupts)

    def read(self, timeout_s: float) -> DriveReading | None:
        for _ in range(2):
            self._step()
        armed_s = (self.now_ns - self._armed_ns) / NS_PER_S if self._armed_ns else 0.0
        if armed_s > self.silent_at_s:
            self.now_ns += round(timeout_s * NS_PER_S)
            return None
        if self.status is DriveStatus.ARMED and armed_s > self.fails_at_s:
            self.status = DriveStatus.ERROR
        return DriveReading(
            self.now_ns,
            motor_from_joint((self.q[0], self.q[1]), self._ratio),
            motor_from_joint((self.v[0], self.v[1]), self._ratio),
            self.status,
            0,
        )

    def write(self, target: MotorTarget) -> None:
        self._target = target

    def arm(self, *, onboard: bool) -> None:
        assert onboard
        if not self.never_arms:
            self.status, self._armed_ns = DriveStatus.ARMED, self.now_ns

    def idle(self) -> None:
        self.idles += 1
        if not self.deaf:
            self.status = DriveStatus.IDLE

    def _step(self) -> None:
        """Move on by a millisecond."""
        self.now_ns += STEP_NS
        tau = joint_torque(self._motors(), self._ratio)
        self.largest = max(self.largest, abs(tau[0]) + abs(tau[1]))
        if self.jammed:
            return
        sign = -1.0 if self.reversed else 1.0
        for axis in (0, 1):
            push = sign * tau[axis] + self.load[axis] - 0.5 * self.v[axis]
            self.v[axis] += push * 1e-3 / 0.5
            slowed = self.friction * 1e-3 / 0.5
            self.v[axis] = math.copysign(max(0.0, abs(self.v[axis]) - slowed), self.v[axis])
            self.q[axis] += 1e-3 * self.v[axis]

    def _motors(self) -> Pair:
        target = self._target
        if self.status is not DriveStatus.ARMED or target is None:
            return (0.0, 0.0)
        pos = motor_from_joint((self.q[0], self.q[1]), self._ratio)
        vel = motor_from_joint((self.v[0], self.v[1]), self._ratio)
        limit = self._drive.current_lim * self._drive.torque_constant
        torques = []
        for i in (0, 1):
            wanted = target.vel_turns[i] + target.pos_gain[i] * (target.pos_turns[i] - pos[i])
            speed = min(self._drive.vel_limit, max(-self._drive.vel_limit, wanted))
            torque = target.torque[i] + target.vel_gain[i] * (speed - vel[i])
            torques.append(min(limit, max(-limit, torque)))
        return (torques[0], torques[1])
