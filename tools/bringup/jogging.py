"""Moving one axis of one module a little and back, by the drive's own loop: law and judgement.

Law, torque limiter and drive targets are the joint service's, so a sign that is right here is right
there. Only the force differs: the drive's own current limit keeps every motor below the requested
torque, whatever happens to this process. Pure; `jog_drive` has the clock and the drive.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Protocol

import msgspec

from services.joint import pd_law
from services.joint.differential import joint_from_motor
from services.joint.drive_setpoint import DriveSetpointLaw
from services.joint.drivers.base import DriveReading, DriveStatus, MotorTarget
from services.joint.torque_limiter import TorqueLimits, limit_torque, limits_of
from shared.bus.messages import Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.sections import StandGains
from shared.exceptions import DriveError
from shared.joints import AXES, kind_of

SETTLE_S: Final = 0.7
"""Held where it is before it moves, and again afterwards."""
VEL_LIMIT: Final = 3.0
"""turn/s at the motor, at least; a drive that is faster disarms by itself (OVERSPEED)."""
VEL_FACTOR: Final = 5.0
"""Factor on the fastest requested rate, where that is more."""
APART_MAX: Final = 0.15
"""rad between reference and joint: no friction explains it."""
OVER_TORQUE: Final = 0.98
"""Fraction of the torque limit, in the sum of both axes, that counts as at the limit."""
OVER_TORQUE_S: Final = 0.2
SILENT_S: Final = 0.2
"""Without a sample for so long, nobody knows where the joint is."""
STRAYED_MAX: Final = 0.05
"""rad that a limp joint may have moved between the look and the arming."""
TRAVEL_SHARE: Final = 0.25
"""Fraction of the requested travel by which the travel may differ."""
LAG_MAX: Final = 0.02
"""rad between reference and joint, beyond the deflection by its load at rest."""
SIBLING_MAX: Final = 0.02
"""rad that the other axis may move."""


class MotionPlan(Protocol):
    """A motion of one axis about where the joint is found."""

    @property
    def axis(self) -> int:
        """0: phi, 1: theta."""

    @property
    def torque_limit(self) -> float:
        """N m at the joint: |tau_phi| + |tau_theta|."""

    @property
    def duration_s(self) -> float:
        """How long the whole takes."""

    @property
    def reach(self) -> tuple[Pair, Pair]:
        """Lowest and highest offset that phi, and that theta, is led to, rad."""

    @property
    def rate_max(self) -> float:
        """Fastest rate that it asks for, rad/s."""

    def gains(self, stand: StandGains) -> tuple[Pair, Pair]:
        """Return k_p, N m/rad, and k_d, N m s/rad, of (phi, theta).

        Args:
            stand: of the module.
        """

    def offset(self, t_s: float) -> tuple[Pair, Pair]:
        """Return the offsets of (phi, theta), rad, and their rates, rad/s.

        Args:
            t_s: since the drive was armed, s.
        """


class JogPlan(NamedTuple):
    """There and back: by/2 (1 - cos) along the axis, between two rests."""

    axis: int
    by: float
    """rad, there and back."""
    period_s: float
    """Period of one motion there and back, s."""
    cycles: int
    torque_limit: float

    @property
    def duration_s(self) -> float:
        """How long the whole takes."""
        return SETTLE_S + self.cycles * self.period_s + SETTLE_S

    @property
    def reach(self) -> tuple[Pair, Pair]:
        """Lowest and highest offset that phi, and that theta, is led to, rad."""
        moved = (min(0.0, self.by), max(0.0, self.by))
        return (moved, pd_law.ZERO) if self.axis == 0 else (pd_law.ZERO, moved)

    @property
    def rate_max(self) -> float:
        """Fastest rate that it asks for, rad/s."""
        return math.pi * abs(self.by) / self.period_s

    def gains(self, stand: StandGains) -> tuple[Pair, Pair]:
        """Return the stand gains."""
        return stand.k_p, stand.k_d

    def offset(self, t_s: float) -> tuple[Pair, Pair]:
        """Return the offsets of (phi, theta), rad, and their rates, rad/s, at a time, s."""
        moving_s = t_s - SETTLE_S
        if not 0.0 <= moving_s <= self.cycles * self.period_s:
            return pd_law.ZERO, pd_law.ZERO
        omega = 2.0 * math.pi / self.period_s
        way = 0.5 * self.by * (1.0 - math.cos(omega * moving_s))
        rate = 0.5 * self.by * omega * math.sin(omega * moving_s)
        return ((way, 0.0), (rate, 0.0)) if self.axis == 0 else ((0.0, way), (0.0, rate))


class Sample(NamedTuple):
    """One cycle."""

    t_s: float
    """Since the drive was armed."""
    q_ref: Pair
    q: Pair
    tau: Pair
    """Requested torque at this sample, N m at the joint."""
    tau_before: Pair = pd_law.ZERO
    """Torque at this sample by the target before it, which the drive had up to now."""


class JogCheck(NamedTuple):
    """One line of the verdict."""

    what: str
    value: str
    wanted: str
    """Remedy; "" if there is none."""
    good: bool


def gentle(robot: RobotConfig, plan: MotionPlan) -> RobotConfig:
    """Return the robot with its drives limited to the plan's torque and speed.

    A motor's torque is at most T / 2N, so that |tau_phi| + |tau_theta| <= T in the drive.

    Raises:
        DriveError: the torque limit is beyond the robot's, or too small to be set.
    """
    drive, joint = robot.drive, robot.joint
    per_ampere = 2.0 * joint.gear_ratio * drive.torque_constant
    most = min(joint.tau_module_max, drive.current_lim * per_ampere)
    if not per_ampere <= plan.torque_limit <= most:
        raise DriveError(
            f"--torque-limit {plan.torque_limit:g}: {per_ampere:.1f} .. {most:.1f} N m are right "
            "(one ampere, and what the robot file allows)"
        )
    asked = plan.rate_max * joint.gear_ratio / (2.0 * math.pi)
    speed = min(drive.vel_limit, max(VEL_LIMIT, VEL_FACTOR * asked))
    limited = msgspec.structs.replace(
        drive, current_lim=plan.torque_limit / per_ampere, vel_limit=speed
    )
    return msgspec.structs.replace(robot, drive=limited)


def outside(robot: RobotConfig, module: str, plan: MotionPlan, q: Pair) -> str:
    """Return why the joint may not go where the plan leads it from q, rad; "" if it may."""
    limits = limits_of(robot, module)
    for axis, (low, high) in enumerate((limits.phi, limits.theta)):
        reach = [q[axis] + offset for offset in plan.reach[axis]]
        if not low <= q[axis] <= high:
            return (
                f"{AXES[axis]} is at {q[axis]:.3f} rad, outside of {low:g} .. {high:g} rad; bring "
                "it inside by hand, or correct its zero (`xrl drive zero`)"
            )
        beyond = [to for to in reach if not low <= to <= high]
        if beyond:
            return (
                f"{AXES[axis]} is at {q[axis]:.3f} rad and would go to {beyond[0]:.3f}, outside of "
                f"{low:g} .. {high:g} rad; move it the other way (a jog: --by with the other "
                "sign), or bring the joint elsewhere by hand"
            )
    return ""


def what_to_see(module: str, axis: int, by: float) -> str:
    """Return a description of the right motion, for a person who watches.

    A positive angle leans the part above the joint forward (theta) or to the right (phi)
    against the part below; below a hanging torso, the lower part swings the same way.
    """
    kind, positive = kind_of(module), by > 0.0
    upper = {"ankle": "shin", "knee": "thigh", "hip": "torso"}[kind]
    if axis == 1:
        way = "forward" if positive else "back"
        foot = "the toes point up" if positive else "the toes point down"
    else:
        way = "to its right" if positive else "to its left"
        foot = f"the sole turns its {'right' if positive else 'left'} edge up"
    lower = {"ankle": foot, "knee": f"the shin swings {way}", "hip": f"the thigh swings {way}"}
    return f"the {upper} leans {way}; where the torso hangs, {lower[kind]}"


class Jog:
    """The law of one jog and its state, cycle by cycle.

    Attributes:
        trouble: why it was stopped; "" if it was not.
        done: the motion is over.
        samples: recorded so far.
    """

    def __init__(
        self, robot: RobotConfig, module: str, plan: MotionPlan, q: Pair, now_ns: int
    ) -> None:
        """Begin at q, rad, with a drive that has just been armed.

        Args:
            robot: as `gentle` made it.
            module: which.
            plan: what to do.
            q: where the joint was found.
            now_ns: monotonic time.
        """
        self._k_p, self._k_d = plan.gains(robot.stand_gains(module))
        limits = limits_of(robot, module)
        self._limits: TorqueLimits = msgspec.structs.replace(
            limits, tau_module_max=min(plan.torque_limit, limits.tau_module_max)
        )
        self._gear_ratio = robot.joint.gear_ratio
        self._onboard = DriveSetpointLaw(robot.joint.gear_ratio, robot.drive.vel_limit)
        self._plan, self._q_start = plan, q
        self._start_ns = self._received_ns = now_ns
        self._at_limit_s: float | None = None
        self._tau: Pair = pd_law.ZERO
        self._setpoint: pd_law.Setpoint | None = None
        self.trouble = ""
        self.done = False
        self.samples: list[Sample] = []

    def step(self, now_ns: int, reading: DriveReading | None) -> MotorTarget | None:
        """Return the drive's next target; None to leave it as it is, or to idle it.

        Args:
            now_ns: monotonic time.
            reading: the newest sample, counted from the joint's zero; None if none came.
        """
        t_s = (now_ns - self._start_ns) / NS_PER_S
        if reading is None:
            if now_ns - self._received_ns > SILENT_S * NS_PER_S:
                self.trouble = f"no sample of the drive for {SILENT_S:g} s"
            return None
        self._received_ns = now_ns
        if reading.status is not DriveStatus.ARMED:
            self.trouble = f"the drive is {reading.status.name}, error 0x{reading.error:x}"
            return None
        q = joint_from_motor(reading.pos_turns, self._gear_ratio)
        v = joint_from_motor(reading.vel_turns, self._gear_ratio)
        q_ref, v_ref = self._reference(t_s)
        before = self._setpoint or pd_law.Setpoint(
            q, pd_law.ZERO, pd_law.ZERO, pd_law.ZERO, self._k_p, self._k_d
        )
        tau_before = pd_law.torque(before, q, v)
        setpoint = pd_law.Setpoint(q_ref, v_ref, pd_law.ZERO, pd_law.ZERO, self._k_p, self._k_d)
        self._tau = limit_torque(pd_law.torque(setpoint, q, v), q, self._tau, self._limits)
        self._setpoint = setpoint
        self.samples.append(Sample(t_s, q_ref, q, self._tau, tau_before))
        self.trouble = self._watch(t_s, q_ref, q)
        self.done = t_s > self._plan.duration_s
        if self.trouble:
            return None
        pos, vel = reading.pos_turns, reading.vel_turns
        return self._onboard.target(now_ns, setpoint, self._tau, pos, vel)

    def _reference(self, t_s: float) -> tuple[Pair, Pair]:
        """Return q_ref, rad, and v_ref, rad/s."""
        (by_phi, by_theta), v_ref = self._plan.offset(t_s)
        phi, theta = self._q_start
        return (phi + by_phi, theta + by_theta), v_ref

    def _watch(self, t_s: float, q_ref: Pair, q: Pair) -> str:
        """Return what speaks against going on; "" if nothing does."""
        for axis in (0, 1):
            if not abs(q[axis] - q_ref[axis]) <= APART_MAX:
                return (
                    f"{AXES[axis]} is at {q[axis]:.3f} rad where {q_ref[axis]:.3f} was asked: "
                    f"more than {APART_MAX:g} rad apart"
                )
        limit = self._limits.tau_module_max
        if abs(self._tau[0]) + abs(self._tau[1]) < OVER_TORQUE * limit:
            self._at_limit_s = None
        elif self._at_limit_s is None:
            self._at_limit_s = t_s
        elif t_s - self._at_limit_s > OVER_TORQUE_S:
            return (
                f"at the torque limit of {limit:g} N m for {OVER_TORQUE_S:g} s: something is in "
                "the way, or the load needs more (--torque-limit)"
            )
        return ""


def judge(samples: list[Sample], plan: JogPlan) -> list[JogCheck]:
    """Return the verdict on a jog that came to its end."""
    axis, other = plan.axis, 1 - plan.axis
    rest = [s for s in samples if s.t_s < SETTLE_S][-20:]
    moving = [s for s in samples if SETTLE_S <= s.t_s <= plan.duration_s - SETTLE_S]
    if not rest or not moving:
        return [
            JogCheck("samples", f"{len(rest)} at rest, {len(moving)} moving", "some of both", False)
        ]
    q_rest = _mean([s.q[axis] for s in rest])
    sag = q_rest - rest[-1].q_ref[axis]
    sign = math.copysign(1.0, plan.by)
    travel = sign * max(sign * (s.q[axis] - q_rest) for s in moving)
    lag = max(abs(s.q[axis] - s.q_ref[axis] - sag) for s in moving)
    still = _mean([s.q[other] for s in rest])
    strayed = max(abs(s.q[other] - still) for s in moving)
    peak = max(abs(s.tau[0]) + abs(s.tau[1]) for s in samples)
    return [
        JogCheck(
            f"{AXES[axis]} went",
            f"{travel:+.4f} rad",
            f"{plan.by:+.4f} within {TRAVEL_SHARE:.0%}",
            abs(travel - plan.by) <= TRAVEL_SHARE * abs(plan.by),
        ),
        JogCheck("largest lag", f"{lag:.4f} rad", f"<= {LAG_MAX:g}", lag <= LAG_MAX),
        JogCheck(
            f"{AXES[other]} strayed",
            f"{strayed:.4f} rad",
            f"<= {SIBLING_MAX:g}",
            strayed <= SIBLING_MAX,
        ),
        JogCheck("torque at rest", f"{_mean([s.tau[axis] for s in rest]):+.2f} N m", "", True),
        JogCheck("largest torque, both axes", f"{peak:.2f} N m", f"< {plan.torque_limit:g}", True),
        JogCheck("friction, dry and viscous", f"{friction(moving, plan):.2f} N m", "", True),
    ]


def friction(moving: list[Sample], plan: JogPlan) -> float:
    """Return half the difference of torque between the way there and the way back, N m.

    Only where the motion is fast; gravity and springs are the same on both ways and cancel.
    """
    omega = 2.0 * math.pi / plan.period_s
    sign = math.copysign(1.0, plan.by)
    there: list[float] = []
    back: list[float] = []
    for s in moving:
        sine = math.sin(omega * (s.t_s - SETTLE_S))
        if abs(sine) > 0.5:
            (there if sine > 0.0 else back).append(sign * s.tau[plan.axis])
    return 0.5 * (_mean(there) - _mean(back)) if there and back else math.nan


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values)
