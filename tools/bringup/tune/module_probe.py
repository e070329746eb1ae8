"""Step and sines at one module of a hanging leg, on its stand gains. Pure."""

from __future__ import annotations

from typing import Final

from shared.config.robot_config import RobotConfig
from tools.bringup.hanging_leg import HEAVY, HangingJoint
from tools.bringup.motion import MotionPlan, Sample
from tools.bringup.tune.excitation import BODY_RATE, Excitation, excitation
from tools.bringup.tune.pose_probe import ProbeCourse, course_from
from tools.bringup.tune.response import SecondOrder

LIGHT_TORQUE: Final = 15.0
HEAVY_TORQUE: Final = 60.0
"""N m; a leg that is moved by less than the play of its drivetrain shows the rotor alone."""
STEP_SHARE: Final = 0.4
"""Fraction of the torque that the step takes when it begins."""
STEP_MAX: Final = 0.02
"""rad"""

ProbePlan = MotionPlan[Excitation]


def probe_plan(
    robot: RobotConfig, module: str, axis: int, torque: float | None, joint: HangingJoint
) -> ProbePlan:
    """Return a step and sines that a module takes with a torque, N m.

    What holds the leg at its place comes on top. None: by what hangs on it.
    """
    if torque is None:
        torque = HEAVY_TORQUE if joint.inertia > HEAVY else LIGHT_TORQUE
    k_p, _ = axis_gains(robot, module, axis)
    size = min(STEP_MAX, STEP_SHARE * torque / k_p)
    scale = predicted(robot, module, axis, joint).natural_frequency / BODY_RATE
    return ProbePlan(axis, excitation(size, scale), torque + joint.held_torque, joint.bias)


def axis_gains(robot: RobotConfig, module: str, axis: int) -> tuple[float, float]:
    """Return an axis's stand gains, N m/rad and N m s/rad."""
    stand = robot.stand_gains(module)
    return stand.k_p[axis], stand.k_d[axis]


def predicted(robot: RobotConfig, module: str, axis: int, joint: HangingJoint) -> SecondOrder:
    """Return what the robot file says: rotor and leg on the gains, gravity besides."""
    k_p, k_d = axis_gains(robot, module, axis)
    inertia = robot.joint.armature + joint.inertia
    return SecondOrder(k_p / inertia, k_d / inertia, (k_p + joint.gravity) / inertia)


def course_of_samples(samples: list[Sample], plan: ProbePlan) -> ProbeCourse:
    """Return the course of the moved axis during the excitation."""
    begin, end = plan.rest_s, plan.duration_s - plan.rest_s
    rows = [s for s in samples if begin <= s.t_s < end]
    r, y = [s.q_ref[plan.axis] for s in rows], [s.q[plan.axis] for s in rows]
    return course_from([s.t_s - begin for s in rows], r, y)
