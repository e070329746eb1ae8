"""Statics of the standing robot, for many moments at once. Pure.

At rest the torso is in balance, in torso axes, whatever each foot bears:

    0 = sum over legs J_i^-T tau_i + harness + weight of torso and knees

J_i (6, 6) is leg i's Jacobian: joint rates to the torso's twist about its origin, with the foot at
rest. Three equations of force and three of moment: they know masses, torques and the harness. And
both legs carry one torso: the left foot, seen from the right one, stays where it is. Six more
equations: they know the angles. Both feet's soles are taken as flat on one floor.

This is a derivation of its own, from the legs' screw axes (`services.planner.law.model`), and
shares nothing with the law's graphs.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from services.planner.law.model import LegGeometry, leg_geometry
from shared.arrays import Array
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import N_LEG

_KNEE_AFTER: Final = 2
"""Joints between foot and knee: those of the ankle."""


class LegPose(NamedTuple):
    """One leg at n moments, seen from its own foot."""

    rotation: Array
    """Torso axes (n, 3, 3): columns are the torso's axes in the foot's."""
    r_torso: Array
    """Torso origin (n, 3), m."""
    J: Array
    """(n, 6, 6): joint rates to velocity and angular velocity of the torso, foot's axes."""
    J_knee: Array
    """(n, 3, 6): joint rates to the knee's velocity, foot's axes."""


class Balance(NamedTuple):
    """Both sets of equations at n moments."""

    wrench: Array
    """(n, 6) N and N m about the torso's origin, torso axes: 0 in balance."""
    by_torque: Array
    """(n, 6, 12): d wrench / d torque of the joints."""
    feet: Array
    """(n, 6): rotation vector (rad) and place (m) of the left foot, in the right one's axes."""


class BodyStatics:
    """The robot of a file, with loads that a caller adds."""

    def __init__(self, robot: RobotConfig) -> None:
        self._legs = leg_geometry(robot)
        self.torso_mass = robot.torso_mass
        """kg"""
        self._knee_mass = robot.mass.module

    def balance(
        self,
        q: Array,
        tau: Array,
        up: Array,
        *,
        mass: float,
        moment: Array,
        force: Array,
        force_moment: Array,
    ) -> Balance:
        """Return the equations' left sides.

        Args:
            q: joint angles (n, 12), rad.
            tau: joint torques (n, 12), N m.
            up: unit vector against gravity in the floor's axes (3,).
            mass: of the torso with all that it carries, kg.
            moment: its mass times its centre (n, 3) or (3,), torso axes, kg m.
            force: of the person on the torso (n, 3), torso axes, N.
            force_moment: the same wrench's moment about the torso's origin (n, 3), N m.
        """
        legs = [
            leg_pose(geometry, q[:, side * N_LEG : (side + 1) * N_LEG])
            for side, geometry in enumerate(self._legs)
        ]
        columns = [_in_torso_axes(leg) for leg in legs]
        ups = [np.einsum("nij,i->nj", leg.rotation, up) for leg in legs]
        up_torso = 0.5 * (ups[0] + ups[1])
        by_torque = np.concatenate(columns, axis=2)
        wrench = np.einsum("nij,nj->ni", by_torque, tau)
        for leg, column in zip(legs, columns, strict=True):
            # the knee's weight, as torques of its own leg
            weight = -self._knee_mass * GRAVITY * np.einsum("nij,i->nj", leg.J_knee, up)
            wrench += np.einsum("nij,nj->ni", column, weight)
        wrench[:, :3] += force - mass * GRAVITY * up_torso
        wrench[:, 3:] += force_moment - GRAVITY * np.cross(moment, up_torso)
        turned = legs[0].rotation @ legs[1].rotation.transpose(0, 2, 1)
        place = legs[0].r_torso - np.einsum("nij,nj->ni", turned, legs[1].r_torso)
        return Balance(wrench, by_torque, np.hstack([rotation_vector(turned), place]))


def leg_pose(geometry: LegGeometry, q: Array) -> LegPose:
    """Return a leg at q (n, 6), rad, by the product of exponentials, from the foot up."""
    n = len(q)
    rotation = np.broadcast_to(np.eye(3), (n, 3, 3))
    shift = np.zeros((n, 3))
    axes, points = [], []
    knee = shift
    for joint in range(N_LEG):
        axis, point = geometry.axes[joint], geometry.points[joint] - geometry.r_foot
        axes.append(rotation @ axis)
        points.append(shift + rotation @ point)
        turned = _turn(axis, q[:, joint])
        shift = shift + np.einsum("nij,nj->ni", rotation, point - turned @ point)
        rotation = rotation @ turned
        if joint == _KNEE_AFTER - 1:
            knee = shift + rotation @ (geometry.r_knee - geometry.r_foot)
    r_torso = shift + rotation @ (geometry.r_torso - geometry.r_foot)
    linear = np.stack([np.cross(a, r_torso - p) for a, p in zip(axes, points, strict=True)], axis=2)
    J_knee = np.zeros((n, 3, N_LEG))
    for joint in range(_KNEE_AFTER):
        J_knee[:, :, joint] = np.cross(axes[joint], knee - points[joint])
    J = np.concatenate([linear, np.stack(axes, axis=2)], axis=1)
    return LegPose(rotation, r_torso, J, J_knee)


def rotation_vector(rotation: Array) -> Array:
    """Return the rotation vectors (n, 3), rad, of small rotations (n, 3, 3), to third order."""
    antisymmetric = 0.5 * np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    sine = np.linalg.norm(antisymmetric, axis=1, keepdims=True)
    return np.asarray(antisymmetric * (1.0 + sine * sine / 6.0), float)


def _in_torso_axes(leg: LegPose) -> Array:
    """Return (n, 6, 6): joint torques to the leg's wrench on the torso, torso axes."""
    inverse = np.linalg.inv(leg.J).transpose(0, 2, 1)
    back = leg.rotation.transpose(0, 2, 1)
    return np.concatenate([back @ inverse[:, :3], back @ inverse[:, 3:]], axis=1)


def _turn(axis: Array, angle: Array) -> Array:
    """Return the rotations (n, 3, 3) about a unit axis (3,) by angles (n,), rad (Rodrigues)."""
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * skew + (1.0 - cosine) * (skew @ skew), float)
