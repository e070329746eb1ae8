"""Step and sines at one module of a hanging leg, on its stand gains. Pure but for the drives."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.config.sections import StandGains
from tools.bringup.identify.joint_drive import Hanging, bias_of
from tools.bringup.identify.sines import BIAS_TORQUE, HEAVY, led_there_and_back, rest_s
from tools.bringup.jogging import Sample
from tools.bringup.tune.excitation import BODY_RATE, Excitation, excitation
from tools.bringup.tune.pose_probe import ProbeCourse
from tools.bringup.tune.response import SecondOrder

LIGHT_TORQUE: Final = 15.0
HEAVY_TORQUE: Final = 60.0
"""N m; a leg that is moved by less than the play of its drivetrain shows the rotor alone."""
STEP_SHARE: Final = 0.4
"""Of the torque that the step takes at its begin."""
STEP_MAX: Final = 0.02
"""rad"""


class ModulePlan(NamedTuple):
    """A module's excitation about a place inside its limits (`jogging.MotionPlan`)."""

    axis: int
    excitation: Excitation
    torque_limit: float
    k_p: float
    """Of the axis, N m/rad."""
    k_d: float
    bias: Pair

    @property
    def duration_s(self) -> float:
        """How long the whole takes, s."""
        return 2.0 * rest_s(self.bias) + self.excitation.duration_s

    @property
    def reach(self) -> tuple[Pair, Pair]:
        """Lowest and highest offset that phi, and that theta, is led to, rad."""
        around = [self.excitation.size if axis == self.axis else 0.0 for axis in (0, 1)]
        phi, theta = ((b - a, b + a) for b, a in zip(self.bias, around, strict=True))
        return phi, theta

    @property
    def rate_max(self) -> float:
        """Fastest rate that it asks for, rad/s."""
        fastest = max(sine.frequency_hz for sine in self.excitation.sines)
        return 2.0 * math.pi * fastest * self.excitation.size

    def gains(self, stand: StandGains) -> tuple[Pair, Pair]:
        """Return the stand gains."""
        return stand.k_p, stand.k_d

    def offset(self, t_s: float) -> tuple[Pair, Pair]:
        """Return the offsets of (phi, theta), rad, and their rates, rad/s, at a time, s."""
        moved = self.excitation.at(t_s - rest_s(self.bias))
        return led_there_and_back(self.bias, t_s, self.duration_s, self.axis, moved, 0.0)


def module_plan(
    robot: RobotConfig, module: str, axis: int, torque: float | None, where: Hanging
) -> ModulePlan:
    """Return a step and sines that a module takes with a torque.

    Args:
        robot: the robot.
        module: its module.
        axis: 0: phi, 1: theta.
        torque: N m; what holds the leg at its place comes on top. None: by what hangs on it.
        where: the leg hangs.
    """
    stand, bias = robot.stand_gains(module), bias_of(robot, module, where)
    if torque is None:
        torque = HEAVY_TORQUE if where.inertia > HEAVY else LIGHT_TORQUE
    k_p, k_d = stand.k_p[axis], stand.k_d[axis]
    size = min(STEP_MAX, STEP_SHARE * torque / k_p)
    scale = predicted(robot, k_p, k_d, where).natural_frequency / BODY_RATE
    held = BIAS_TORQUE * where.gravity * sum(map(abs, bias))
    return ModulePlan(axis, excitation(size, scale), torque + held, k_p, k_d, bias)


def predicted(robot: RobotConfig, k_p: float, k_d: float, where: Hanging) -> SecondOrder:
    """Return what the robot file says: rotor and leg on the gains, gravity besides."""
    inertia = robot.joint.armature + where.inertia
    return SecondOrder(k_p / inertia, k_d / inertia, (k_p + where.gravity) / inertia)


def course_of_samples(samples: list[Sample], plan: ModulePlan) -> ProbeCourse:
    """Return the course of the moved axis during the excitation."""
    begin, end = rest_s(plan.bias), plan.duration_s - rest_s(plan.bias)
    rows = [s for s in samples if begin <= s.t_s < end]
    t_s = np.array([s.t_s - begin for s in rows])
    r = np.array([s.q_ref[plan.axis] for s in rows])
    y = np.array([s.q[plan.axis] for s in rows])
    return (
        ProbeCourse(t_s, r - r[0], y - y[0], "") if rows else ProbeCourse(t_s, r, y, "no samples")
    )
