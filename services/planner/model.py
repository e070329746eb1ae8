"""The robot in Pinocchio, loaded from the generated MJCF, and as screw axes.

Pinocchio reads the one model source (`shared.robot_model`), whose root is the torso.
What the law needs is each leg from its foot up, for the feet are what stands still:
the six screw axes of a leg in its foot's frame and the torso's place at q = 0
(product of exponentials: T_torso(q) = exp(s_1 q_1) ... exp(s_6 q_6) T_torso(0)).
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from shared.config import RobotConfig
from shared.joints import SIDES
from shared.robot_model import ankle_positions, mjcf

Array = NDArray[np.float64]

_TREE_OF_LEG: Final = np.array([[5, 4, 3, 2, 1, 0], [11, 10, 9, 8, 7, 6]])
"""Place in tree order (hip theta, hip phi, ... from the torso down) of a leg's joints."""


class LegGeometry(NamedTuple):
    """One leg at q = 0, in world axes, its foot where it stands."""

    r_foot: Array
    """Ankle (3,), m."""
    axes: Array
    """Unit joint axes (6, 3), foot up: positive turns the torso's side."""
    points: Array
    """A point on each axis (6, 3), m."""
    r_knee: Array
    """(3,), m."""
    r_torso: Array
    """The torso's origin as this leg carries it (3,), m; its axes are the world's."""


def load_pinocchio(config: RobotConfig) -> pin.Model:
    """Return the Pinocchio model: free torso root, 12 joints; nq = 19, nv = 18."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"  # this Pinocchio reads MJCF from files only
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
    legs = []
    for side, columns, r_foot in zip(SIDES, _TREE_OF_LEG, ankle_positions(config), strict=True):
        foot, knee = (_joint(model, kind, side) for kind in ("ankle", "knee"))
        shift = np.array(r_foot) - data.oMi[foot].translation
        screws = data.J[:, 6 + columns].T
        # the torso against the foot turns as the foot against the torso, reversed
        axes = -screws[:, 3:]
        points = np.cross(axes, -screws[:, :3]) + shift
        r_knee = data.oMi[knee].translation + shift
        legs.append(LegGeometry(np.array(r_foot), axes, points, r_knee, shift))
    return legs[0], legs[1]


def _joint(model: pin.Model, kind: str, side: str) -> int:
    name = f"{kind}_{side}_theta"
    return next(i for i, joint in enumerate(model.names) if joint.endswith(name))


class BodyInertia:
    """Inertia of the body along p with both feet where they are, without the rotors."""

    def __init__(self, config: RobotConfig) -> None:
        """Load the model."""
        self._model = load_pinocchio(config)
        self._model.armature = np.zeros(self._model.nv)
        self._data = self._model.createData()
        self._foot = _joint(self._model, "ankle", SIDES[0])

    def at(self, q: Array, T: Array) -> Array:
        """Return M (6, 6): kinetic energy is p'^T M p' / 2.

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
        # the torso moves so that the foot does not; by T the other one does not either
        rates[:6] = -np.linalg.solve(J_foot[:, :6], J_foot[:, 6:] @ rates[6:])
        return np.asarray(rates.T @ M @ rates, float)
