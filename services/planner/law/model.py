"""Robot model in Pinocchio, and each leg's screw axes from the foot up.

Pinocchio reads the MJCF that `shared.robot.robot_model` generates, the only source of the model.
The root of its tree is the torso. The feet stand still, so the law needs each leg from the foot up:
its six screw axes in the foot's frame, and the torso's position at q = 0. The product of
exponentials is T_torso(q) = exp(s_1 q_1) ... exp(s_6 q_6) T_torso(0).
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pinocchio as pin

from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.joints import SIDES
from shared.robot.robot_model import ankle_positions, mjcf

_TREE_OF_LEG: Final = np.array([[5, 4, 3, 2, 1, 0], [11, 10, 9, 8, 7, 6]])
"""Index in Pinocchio's tree (hip theta, hip phi, ... from the torso down) of each leg joint, (2,
6)."""


class LegGeometry(NamedTuple):
    """One leg at q = 0 in world axes, with its foot at the configured position."""

    r_foot: Array
    """Ankle (3,), m."""
    axes: Array
    """Unit joint axes (6, 3), from the foot up. A positive angle turns the link above the joint."""
    points: Array
    """A point on each axis (6, 3), m."""
    r_knee: Array
    """Knee (3,), m."""
    r_torso: Array
    """Torso origin, m (3,). The torso's axes are the world's."""


def load_pinocchio(config: RobotConfig) -> pin.Model:
    """Return the Pinocchio model: free torso root, 12 joints; nq = 19, nv = 18."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"  # this version of Pinocchio reads MJCF from files only
        path.write_text(mjcf(config), encoding="utf-8")
        return pin.buildModelFromMJCF(str(path))


def q_tree(q: Array, model: pin.Model) -> Array:
    """Return Pinocchio's configuration (19,) for joint angles q (12,), torso at the origin."""
    full: Array = pin.neutral(model)
    full[:3] = -model.jointPlacements[1].translation
    full[7 + _TREE_OF_LEG.ravel()] = q
    return full


def leg_geometry(config: RobotConfig) -> tuple[LegGeometry, LegGeometry]:
    """Return (right, left) at q = 0, read from the Pinocchio model."""
    model = load_pinocchio(config)
    data = model.createData()
    pin.computeJointJacobians(model, data, q_tree(np.zeros(12), model))
    geometries = []
    for side, columns, r_foot in zip(SIDES, _TREE_OF_LEG, ankle_positions(config), strict=True):
        foot, knee = (_joint_index(model, kind, side) for kind in ("ankle", "knee"))
        foot_offset = np.array(r_foot) - data.oMi[foot].translation
        screws = data.J[:, 6 + columns].T
        # the torso's rotation relative to the foot is the inverse of the foot's relative to the
        # torso
        axes = -screws[:, 3:]
        points = np.cross(axes, -screws[:, :3]) + foot_offset
        r_knee = data.oMi[knee].translation + foot_offset
        geometries.append(LegGeometry(np.array(r_foot), axes, points, r_knee, foot_offset))
    return geometries[0], geometries[1]


def _joint_index(model: pin.Model, kind: str, side: str) -> int:
    name = f"{kind}_{side}_theta"
    return next(i for i, joint in enumerate(model.names) if joint.endswith(name))


class BodyInertia:
    """Inertia of the body along p with both feet fixed, without the rotors."""

    def __init__(self, config: RobotConfig) -> None:
        self._model = load_pinocchio(config)
        self._model.armature = np.zeros(self._model.nv)
        self._data = self._model.createData()
        self._foot = _joint_index(self._model, "ankle", SIDES[0])

    def at(self, q: Array, T: Array) -> Array:
        """Return M (6, 6) in kg, kg m and kg m^2; the kinetic energy is p'^T M p' / 2.

        Args:
            q: joint angles (12,), rad, at which the legs agree.
            T: joint rates per unit of p along the closed chain (12, 6).
        """
        model, data = self._model, self._data
        full = q_tree(q, model)
        M = pin.crba(model, data, full)
        M = np.triu(M) + np.triu(M, 1).T
        pin.computeJointJacobians(model, data, full)
        J_foot = pin.getJointJacobian(
            model, data, self._foot, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        rates = np.zeros((model.nv, 6))
        rates[6 + _TREE_OF_LEG.ravel()] = T
        # the torso moves so that the right foot stays; T keeps the left foot in place too
        rates[:6] = -np.linalg.solve(J_foot[:, :6], J_foot[:, 6:] @ rates[6:])
        return np.asarray(rates.T @ M @ rates, float)


class HangingLegs:
    """Joint statics and inertia while the torso hangs upright and still, feet in the air."""

    def __init__(self, config: RobotConfig) -> None:
        self._model = load_pinocchio(config)
        self._model.armature = np.zeros(self._model.nv)
        self._data = self._model.createData()

    def inertia(self, q: Array) -> Array:
        """Return the inertia about each joint (12,), kg m^2, without rotor, the other joints held.

        Args:
            q: joint angles (12,), rad.
        """
        M = pin.crba(self._model, self._data, q_tree(q, self._model))
        return np.asarray(np.diag(M)[6 + _TREE_OF_LEG.ravel()], float)

    def torque(self, q: Array) -> Array:
        """Return the torques that hold up the hanging legs (12,), N m.

        Args:
            q: joint angles (12,), rad.
        """
        tau = pin.computeGeneralizedGravity(self._model, self._data, q_tree(q, self._model))
        return np.asarray(tau[6 + _TREE_OF_LEG.ravel()], float)
