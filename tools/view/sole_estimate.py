"""Force and centre of pressure of each sole, estimated from the legs' joint torques.

A leg without mass hands on what its foot gets from the floor: w = J^-T tau, the wrench on the
torso, is the floor's on the foot. Of the leg's own mass only the weight is added. At rest it is
right within some percent; on a robot nothing else measures the soles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.planner.law.kinematics import DETERMINANT_MIN
from services.planner.law.model import LegGeometry, leg_geometry
from services.simulator.physics.soles import SoleLoad
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import N_LEG

Array = NDArray[np.float64]

LEAST_N: Final = 20.0
"""A sole that bears less has no centre of pressure worth showing."""


class SoleEstimate:
    """Both soles, with the feet where the robot file has them."""

    def __init__(self, config: RobotConfig) -> None:
        self._legs = leg_geometry(config)
        self._foot_height = config.geometry.foot_height
        self._leg_weight = 2.0 * config.mass.module * GRAVITY  # knee and ankle

    def of(self, q: Sequence[float], tau: Sequence[float]) -> tuple[SoleLoad, SoleLoad] | None:
        """Return the loads of the right and the left sole; None where a leg is too straight."""
        found = []
        for index, leg in enumerate(self._legs):
            part = slice(index * N_LEG, (index + 1) * N_LEG)
            load = self._of_leg(leg, np.array(q[part]), np.array(tau[part]))
            if load is None:
                return None
            found.append(load)
        return found[0], found[1]

    def _of_leg(self, leg: LegGeometry, q: Array, tau: Array) -> SoleLoad | None:
        J, r_torso = jacobian(leg, q)
        if abs(np.linalg.det(J)) < DETERMINANT_MIN:
            return None
        wrench = np.linalg.solve(J.T, tau)
        force, moment = wrench[:3], wrench[3:]
        moment = moment + np.cross(r_torso - leg.r_foot, force)  # about the ankle
        f_x, f_y, f_z = force.tolist()
        f_z += self._leg_weight
        if f_z < LEAST_N:
            return SoleLoad((f_x, f_y, f_z), (0.0, 0.0))
        x = leg.r_foot[0] + (-moment[1] - self._foot_height * f_x) / f_z
        y = leg.r_foot[1] + (moment[0] - self._foot_height * f_y) / f_z
        return SoleLoad((f_x, f_y, f_z), (float(x), float(y)))


def jacobian(leg: LegGeometry, q: Array) -> tuple[Array, Array]:
    """Return the torso's velocity per joint rate (6, 6), linear above angular, and its origin (3,).

    By the product of exponentials, from the foot up; m, rad, world.
    """
    R, t = np.eye(3), np.zeros(3)
    axes, points = [], []
    for axis, point, angle in zip(leg.axes, leg.points, q.tolist(), strict=True):
        axes.append(R @ axis)
        points.append(R @ point + t)
        turn = _turn(axis, angle)
        t = R @ (point - turn @ point) + t
        R = R @ turn
    r_torso = R @ leg.r_torso + t
    columns = [
        np.concatenate((np.cross(axis, r_torso - point), axis))
        for axis, point in zip(axes, points, strict=True)
    ]
    return np.array(columns).T, r_torso


def _turn(axis: Array, angle: float) -> Array:
    """Return the rotation matrix about a unit axis (Rodrigues)."""
    x, y, z = axis.tolist()
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * (K @ K))
