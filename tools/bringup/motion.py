"""A small motion of one axis, out and back, by the drive's own loop: plan, limits and guards. Pure.

Law, torque limiter and drive targets are those of the joint service, so a sign that is right here
is right there. Only the limits of torque and speed differ: the drive itself enforces the plan's,
even if this process dies. `motion_runner` has the clock and the drives.
"""

from __future__ import annotations

import math
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeVar

import msgspec

from services.joint import pd_law
from services.joint.differential import TorqueLimits, joint_from_motor, limit_torque, limits_of
from services.joint.drive_setpoint import DriveGains, DriveSetpointLaw
from services.joint.drivers.base import DriveReading, MotorTarget
from shared.bus.messages import DriveStatus, Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import AXES, KINDS
from shared.robot.robot_model import HARD_STOP_MARGIN

SETTLE_S: Final = 0.7
"""Time for which the joint is held before and after the motion, s."""
BIAS_S: Final = 2.0
"""Duration of the motion to the bias, s."""
VEL_LIMIT: Final = 3.0
"""Minimum of the motor's speed limit, turn/s; beyond the limit a drive disarms (OVERSPEED)."""
VEL_FACTOR: Final = 5.0
"""Speed limit as a multiple of the maximum requested rate, if above `VEL_LIMIT`."""
APART_MAX: Final = 0.15
"""Maximum distance between reference and joint that friction can explain, rad."""
OVER_TORQUE: Final = 0.98
"""Fraction of the torque limit from which the sum of both axes counts as at the limit."""
OVER_TORQUE_S: Final = 0.2
SILENT_S: Final = 0.2
"""Timeout for a sample, s; afterwards the joint's position is unknown."""
STRAYED_MAX: Final = 0.05
"""Maximum motion of a limp joint between the check and the arming, rad."""
STOP_ROOM: Final = 0.02
"""Allowance beyond a stop for zero errors of the encoders and a yielding stop, rad."""


class AxisCourse(Protocol):
    """Motion of one axis that starts and ends at the same position."""

    @property
    def duration_s(self) -> float:
        """Duration, s."""

    @property
    def span(self) -> Pair:
        """Lowest and highest offset, rad."""

    @property
    def rate_max(self) -> float:
        """Maximum requested rate, rad/s."""

    def at(self, t_s: float) -> Pair:
        """Return offset, rad, and rate, rad/s, at a time within the duration."""


class Stay:
    """Course of a held module: no motion, for an unlimited time."""

    duration_s: float = math.inf
    span: Pair = pd_law.ZERO
    rate_max: float = 0.0

    def at(self, t_s: float) -> Pair:  # noqa: ARG002 - the same at all times
        """Return zero offset and zero rate."""
        return pd_law.ZERO


C = TypeVar("C", bound=AxisCourse)


class MotionPlan(NamedTuple, Generic[C]):
    """Course of one axis about the joint's present position, plus a bias if given."""

    axis: int
    """0: phi, 1: theta."""
    course: C
    torque_limit: float
    """Maximum of |tau_phi| + |tau_theta|, N m at the joint."""
    bias: Pair = pd_law.ZERO
    """Offset to which the module is moved first, rad, because a hanging knee is on its stop."""
    own_gains: tuple[Pair, Pair] | None = None
    """k_p, N m/rad, and k_d, N m s/rad, of (phi, theta); None for the module's stand gains."""

    @property
    def rest_s(self) -> float:
        """Time before and after the course, including the motion to the bias, s."""
        return SETTLE_S + (BIAS_S + SETTLE_S if any(self.bias) else 0.0)

    @property
    def duration_s(self) -> float:
        """Duration of the whole motion, s."""
        return 2.0 * self.rest_s + self.course.duration_s

    @property
    def reach(self) -> tuple[Pair, Pair]:
        """Lowest and highest offsets of phi, and of theta, rad."""
        phi, theta = (
            (self.bias[axis] + low, self.bias[axis] + high)
            for axis in (0, 1)
            for low, high in [self.course.span if axis == self.axis else pd_law.ZERO]
        )
        return phi, theta

    def offset(self, t_s: float) -> tuple[Pair, Pair]:
        """Return the offsets of (phi, theta), rad, and their rates, rad/s.

        Args:
            t_s: time since the drive was armed, s.
        """
        left_s, along_s = self.duration_s - t_s, t_s - self.rest_s
        inside = 0.0 <= along_s <= self.course.duration_s
        moved, rate = self.course.at(along_s) if inside else pd_law.ZERO
        phase = min(1.0, max(0.0, (min(t_s, left_s) - SETTLE_S) / BIAS_S))
        way = 0.5 - 0.5 * math.cos(math.pi * phase)
        side = 1.0 if t_s < left_s else -1.0
        slope = side * 0.5 * math.pi / BIAS_S * math.sin(math.pi * phase)
        (phi, theta), own = self.bias, (1.0 - self.axis, float(self.axis))
        return (
            (way * phi + own[0] * moved, way * theta + own[1] * moved),
            (slope * phi + own[0] * rate, slope * theta + own[1] * rate),
        )


AnyPlan = MotionPlan[Any]


class Sample(NamedTuple):
    """Sample of one cycle."""

    t_s: float
    """Time since the drive was armed, s."""
    q_ref: Pair
    q: Pair
    tau: Pair
    """Requested torque at this sample, N m at the joint."""
    tau_before: Pair = pd_law.ZERO
    """Torque at this sample by the previous target, which was active until now, N m."""


def limit_drives(robot: RobotConfig, plan: AnyPlan) -> RobotConfig:
    """Return the robot with drives limited to the plan's torque, and well above its speed.

    A motor's torque is at most T / 2N, so that |tau_phi| + |tau_theta| <= T in the drive.

    Raises:
        DriveError: the torque limit exceeds the robot's, or is below the torque of one ampere.
    """
    drive, joint = robot.drive, robot.joint
    per_ampere = 2.0 * joint.gear_ratio * drive.torque_constant
    most = min(joint.tau_module_max, drive.current_lim * per_ampere)
    if not per_ampere <= plan.torque_limit <= most:
        raise DriveError(
            f"--torque-limit {plan.torque_limit:g}: must be {per_ampere:.1f} to {most:.1f} N m "
            "(from the torque of one ampere to the limit of the robot file)"
        )
    asked = plan.course.rate_max * joint.gear_ratio / (2.0 * math.pi)
    speed = min(drive.vel_limit, max(VEL_LIMIT, VEL_FACTOR * asked))
    limited = msgspec.structs.replace(
        drive, current_lim=plan.torque_limit / per_ampere, vel_limit=speed
    )
    return msgspec.structs.replace(robot, drive=limited)


def within_stops(robot: RobotConfig) -> RobotConfig:
    """Return the robot with its limits at the mechanical stops, where a hanging leg may rest."""
    limits, m = {}, HARD_STOP_MARGIN + STOP_ROOM
    for kind in KINDS:
        limit = getattr(robot.limits, kind)
        (a, b), (c, d) = limit.phi, limit.theta
        limits[kind] = msgspec.structs.replace(limit, phi=(a - m, b + m), theta=(c - m, d + m))
    return msgspec.structs.replace(robot, limits=msgspec.structs.replace(robot.limits, **limits))


def why_out_of_reach(robot: RobotConfig, module: str, plan: AnyPlan, q: Pair) -> str:
    """Return why the plan must not move the joint from q, rad, or ""."""
    limits = limits_of(robot, module)
    for axis, (low, high) in enumerate((limits.phi, limits.theta)):
        if not low <= q[axis] <= high:  # so that a NaN is outside
            return (
                f"{AXES[axis]} is at {q[axis]:.3f} rad, outside of {low:g} to {high:g} rad; move "
                "it inside by hand, or correct the joint's zero with `xrl drive zero`"
            )
        ends = [q[axis] + offset for offset in plan.reach[axis]]
        beyond = [end for end in ends if not low <= end <= high]
        if beyond:
            return (
                f"{AXES[axis]} is at {q[axis]:.3f} rad and would go to {beyond[0]:.3f}, outside of "
                f"{low:g} to {high:g} rad; move it the other way (jog: change the sign of --by), "
                "or first move the joint by hand"
            )
    return ""


def why_strayed(q: Pair, q_seen: Pair) -> str:
    """Return a description of how far a joint moved since it was checked; "" if it did not."""
    strayed = max(abs(q[0] - q_seen[0]), abs(q[1] - q_seen[1]))
    if strayed <= STRAYED_MAX:
        return ""
    return f"the joint moved by {strayed:.3f} rad before it was armed"


class GuardedMotion:
    """Law of one motion, run once per cycle, and its state.

    Attributes:
        trouble: reason for stopping the motion, or "".
        done: True if the motion is over.
        samples: samples so far.
    """

    def __init__(
        self, robot: RobotConfig, module: str, plan: AnyPlan, q: Pair, now_ns: int
    ) -> None:
        """Start at q, rad, with a newly armed drive; `robot` is from `limit_drives`."""
        stand = robot.stand_gains(module)
        self._k_p, self._k_d = plan.own_gains or (stand.k_p, stand.k_d)
        limits = limits_of(robot, module)
        self._limits: TorqueLimits = msgspec.structs.replace(
            limits, tau_module_max=min(plan.torque_limit, limits.tau_module_max)
        )
        self._gear_ratio = robot.joint.gear_ratio
        self._onboard = DriveSetpointLaw(robot.joint.gear_ratio, robot.drive.vel_limit)
        self._gains = DriveGains()
        self._plan, self._q_start = plan, q
        self._start_ns = self._received_ns = now_ns
        self._at_limit_s: float | None = None
        self._tau: Pair = pd_law.ZERO
        self._setpoint: pd_law.Setpoint | None = None
        self.trouble = ""
        self.done = False
        self.samples: list[Sample] = []

    def step(self, now_ns: int, reading: DriveReading | None) -> MotorTarget | None:
        """Return the drive's next target; None to keep the last one, or if `trouble` is set.

        Args:
            now_ns: monotonic time.
            reading: the newest sample, counted from the joint's zero, or None.
        """
        t_s = (now_ns - self._start_ns) / NS_PER_S
        if reading is None:
            if now_ns - self._received_ns > SILENT_S * NS_PER_S:
                self.trouble = f"no sample from the drive for {SILENT_S:g} s"
            return None
        self._received_ns = now_ns
        if reading.status is not DriveStatus.ARMED:
            self.trouble = f"the drive is {reading.status.name}, error 0x{reading.error:x}"
            return None
        q = joint_from_motor(reading.pos_turns, self._gear_ratio)
        v = joint_from_motor(reading.vel_turns, self._gear_ratio)
        (by_phi, by_theta), v_ref = self._plan.offset(t_s)
        q_ref = (self._q_start[0] + by_phi, self._q_start[1] + by_theta)
        before = self._setpoint or pd_law.Setpoint(
            q, pd_law.ZERO, pd_law.ZERO, pd_law.ZERO, self._k_p, self._k_d
        )
        tau_before = pd_law.torque(before, q, v)
        setpoint = pd_law.Setpoint(q_ref, v_ref, pd_law.ZERO, pd_law.ZERO, self._k_p, self._k_d)
        self._tau = limit_torque(pd_law.torque(setpoint, q, v), q, self._tau, self._limits)
        self._setpoint = setpoint
        self.samples.append(Sample(t_s, q_ref, q, self._tau, tau_before))
        self.trouble = self._why_stop(t_s, q_ref, q)
        self.done = t_s > self._plan.duration_s
        if self.trouble:
            return None
        pos, vel = reading.pos_turns, reading.vel_turns
        return self._onboard.target(self._gains, now_ns, setpoint, self._tau, pos, vel)

    def _why_stop(self, t_s: float, q_ref: Pair, q: Pair) -> str:
        """Return why the motion must stop, or ""."""
        for axis in (0, 1):
            if not abs(q[axis] - q_ref[axis]) <= APART_MAX:
                return (
                    f"{AXES[axis]} is at {q[axis]:.3f} rad, but its reference is "
                    f"{q_ref[axis]:.3f}: more than {APART_MAX:g} rad apart"
                )
        limit = self._limits.tau_module_max
        if abs(self._tau[0]) + abs(self._tau[1]) < OVER_TORQUE * limit:
            self._at_limit_s = None
        elif self._at_limit_s is None:
            self._at_limit_s = t_s
        elif t_s - self._at_limit_s > OVER_TORQUE_S:
            return (
                f"at the torque limit of {limit:g} N m for {OVER_TORQUE_S:g} s: something is in "
                "the way, or the load needs a higher --torque-limit"
            )
        return ""
