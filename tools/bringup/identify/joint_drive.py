"""Moves one joint of a hanging leg, the leg's other modules held where they hang."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import Drive, DriveReading
from services.joint.torque_limiter import limits_of
from services.planner.law.model import HangingLegs
from shared.bus.messages import Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import MODULE_INDEX, MODULES, N_JOINTS
from tools.bringup import jog_drive
from tools.bringup.held_module import HeldModule
from tools.bringup.identify.sines import SinePlan, plan_for
from tools.bringup.jogging import MotionPlan, Sample, gentle
from tools.bringup.stops import within_stops

STILL: Final = 0.004
"""rad that a leg which hangs still moves in `STILL_FOR_S`; an idle drive may report no rate."""
STILL_FOR_S: Final = 1.5
"""More than half a swing of the leg."""
STILL_WAIT_S: Final = 60.0
INSIDE: Final = 0.12
"""rad inside its limits that a joint is led to: room for the sines."""


class Hanging(NamedTuple):
    """A leg as it hangs."""

    q: dict[str, Pair]
    """Angles of its three modules, (phi, theta), rad."""
    inertia: float
    """Inertia of what hangs on the joint by the robot file, without its rotor, kg m^2."""
    gravity: float
    """Stiffness that gravity gives the joint, N m/rad."""


def leg_of(module: str) -> tuple[str, ...]:
    """Return the modules of a module's leg."""
    side = module.rpartition("_")[2]
    return tuple(name for name in MODULES if name.endswith(f"_{side}"))


def hanging(robot: RobotConfig, q: Mapping[str, Pair], module: str, axis: int) -> Hanging:
    """Return what the robot file says of a joint of a leg that hangs at q, rad."""
    legs, at = HangingLegs(robot), np.zeros(N_JOINTS)
    for name, (phi, theta) in q.items():
        index = 2 * MODULE_INDEX[name]
        at[index], at[index + 1] = phi, theta
    joint, by = 2 * MODULE_INDEX[module] + axis, np.zeros(N_JOINTS)
    by[joint] = 1e-4
    slope = (legs.torque(at + by)[joint] - legs.torque(at - by)[joint]) / 2e-4
    return Hanging(dict(q), float(legs.inertia(at)[joint]), abs(float(slope)))


def plan_at(robot: RobotConfig, module: str, axis: int, torque: float, where: Hanging) -> SinePlan:
    """Return the sines of a joint, led inside its limits first.

    Args:
        robot: the robot.
        module: its module.
        axis: 0: phi, 1: theta.
        torque: of the sines, N m.
        where: it hangs.
    """
    inertia = where.inertia + robot.joint.armature
    return plan_for(axis, torque, inertia, where.gravity, bias_of(robot, module, where))


def bias_of(robot: RobotConfig, module: str, where: Hanging) -> Pair:
    """Return how far a module must be led to be well inside its limits, (phi, theta), rad."""
    limits = limits_of(robot, module)
    phi, theta = (
        min(max(value, low + INSIDE), high - INSIDE) - value
        for value, (low, high) in zip(where.q[module], (limits.phi, limits.theta), strict=True)
    )
    return phi, theta


def wait_until_still(
    drives: Mapping[str, Drive],
    robot: RobotConfig,
    interrupts: jog_drive.Interrupts,
    clock: jog_drive.Clock,
) -> dict[str, Pair] | None:
    """Wait until a leg hangs still; return where, (phi, theta), rad; None if interrupted.

    Args:
        drives: of the leg, idle.
        robot: gear ratio.
        interrupts: end the wait.
        clock: monotonic, ns.

    Raises:
        DriveError: it does not in a minute, or a drive does not answer.
    """
    begin = still_since = clock()
    rest: dict[str, Pair] = {}
    while True:
        q = {}
        for name, drive in drives.items():
            reading = _first(drive, name, clock)
            phi, theta = q[name] = joint_from_motor(reading.pos_turns, robot.joint.gear_ratio)
            at = rest.get(name, (math.inf, math.inf))
            if max(abs(phi - at[0]), abs(theta - at[1])) > STILL:
                rest, still_since = {}, clock()
        rest = rest or q
        if clock() - still_since > STILL_FOR_S * NS_PER_S:
            return q
        if interrupts.number:
            return None
        if clock() - begin > STILL_WAIT_S * NS_PER_S:
            raise DriveError("the leg swings: hold it still, and again")


def _first(drive: Drive, name: str, clock: jog_drive.Clock) -> DriveReading:
    try:
        return jog_drive.first_reading(drive, clock)
    except DriveError as error:
        raise DriveError(f"{name}: {error}") from None


class LegResult(NamedTuple):
    """How a motion of a leg ended."""

    samples: list[Sample]
    trouble: str
    """Why it was stopped; "" if it came to its end."""
    not_idle: tuple[str, ...]
    """Modules whose drives do not say that they are idle."""


def move(
    drives: Mapping[str, Drive],
    robot: RobotConfig,
    module: str,
    plan: MotionPlan,
    *,
    q_seen: Mapping[str, Pair],
    interrupts: jog_drive.Interrupts,
    progress: Callable[[Sample], None],
    clock: jog_drive.Clock,
) -> LegResult:
    """Hold the leg, move the joint, and idle all, whatever happens.

    A held module that moves, or whose drive faults, stops the motion.

    Args:
        drives: the leg's, idle, opened with the limits of `limited`.
        robot: as `limited` made it.
        module: that is moved.
        plan: its motion.
        q_seen: joint angles when the person agreed, rad.
        interrupts: read in every cycle.
        progress: receives a sample now and then.
        clock: monotonic, ns.
    """
    held = [
        HeldModule(drive, robot, name, plan.torque_limit, clock)
        for name, drive in drives.items()
        if name != module
    ]
    samples: list[Sample] = []
    not_idle: list[str] = []
    trouble = ""
    try:
        for one in held:
            trouble = trouble or one.hold(interrupts)
        if not trouble:
            result = jog_drive.jog_drive(
                drives[module], robot, module, plan, q_seen=q_seen[module], interrupts=interrupts,
                progress=progress, clock=clock, watch=lambda: _first_of(held),
            )  # fmt: skip
            samples, trouble = result.samples, result.trouble
            not_idle += [] if result.is_idle else [module]
    except BaseException as error:
        left = [one.module for one in held if not one.release()]
        if left:
            error.add_note(f"{', '.join(left)}: {jog_drive.NOT_IDLE}")
        raise
    not_idle += [one.module for one in held if not one.release()]
    return LegResult(samples, trouble, tuple(not_idle))


def _first_of(held: Sequence[HeldModule]) -> str:
    """Keep all; return the first trouble."""
    troubles = [trouble for one in held if (trouble := one.keep())]
    return troubles[0] if troubles else ""


def limited(robot: RobotConfig, plan: MotionPlan) -> RobotConfig:
    """Return the robot with torque, speed and joint limits for a plan.

    Raises:
        DriveError: the torque is beyond the robot's.
    """
    return gentle(within_stops(robot), plan)
