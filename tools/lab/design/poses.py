"""Standing poses over COM height and pitch, with the inputs of the certificates. Offline."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.planner.law.gains import GainLaw
from services.planner.law.inverse_kinematics import InverseKinematics
from services.planner.law.kinematics import Kinematics
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import N_JOINTS, N_LEG
from shared.robot.robot_model import stand_pose

Array = NDArray[np.float64]

REACH_STEP: Final = 0.005
"""m; resolution of the ends of the height range."""
MID_HEIGHT_FRACTION: Final = 0.8
"""Fraction of the straight leg: height of the pose from which every other pose is approached."""


class PoseNode(NamedTuple):
    """Inputs of the certificate at a pose."""

    T: Array
    """(12, 6)"""
    hessians: tuple[Array, Array]
    """`hessian_times` without and with the full assist (12, 12), N m/rad."""
    D_max: Array
    """(6,) N m/rad"""


class Poses:
    """Upright and pitched stands of a robot, COM over the ankles."""

    def __init__(self, config: RobotConfig) -> None:
        """Start in the middle of the height range."""
        self._config = config
        self.kinematics = Kinematics(config)
        """Updated at the last pose."""
        self._ik = InverseKinematics(self.kinematics, np.array(config.joint_limits()))
        self._gains = GainLaw(config)
        self._F_O: Array = np.zeros(6)
        self._F_O[2] = config.total_mass * GRAVITY
        self._no_assist, self._assist = np.zeros(3), np.array([0.0, 0.0, config.assist.force_max])
        reach = config.geometry.l1 + config.geometry.l2
        self._ik.q[:] = stand_pose(config, MID_HEIGHT_FRACTION * reach)
        self.kinematics.update(self._ik.q)
        self._middle = float(self.kinematics.p[2])

    @property
    def q(self) -> Array:
        """Joint angles (12,) of the last pose, rad."""
        return self._ik.q.copy()

    def _solve_stand(self, z: float, pitch: float) -> bool:
        """Solve for a pose; return False and keep the last pose if it cannot be reached."""
        before = self._ik.q.copy()
        p_ref = np.array([0.0, 0.0, z, 0.0, pitch, 0.0])
        if self._ik.solve(p_ref, iterations_max=50).converged:
            return True
        if self._ik.solve_from_anywhere(p_ref).converged:
            return True
        self._ik.q[:] = before
        return False

    def reach(self) -> tuple[float, float]:
        """Return the lowest and the highest COM height of an upright stand, m."""
        ends = []
        for step in (-REACH_STEP, REACH_STEP):
            z = self._middle
            self._solve_stand(z, 0.0)
            while self._solve_stand(z + step, 0.0):
                z += step
            ends.append(z)
        return ends[0], ends[1]

    def outwards(self, z: float, pitches: Sequence[float]) -> Iterator[tuple[int, float]]:
        """Yield (index, pitch), from upright outwards; each pose starts from its neighbour."""
        upright = min(range(len(pitches)), key=lambda j: abs(pitches[j]))
        for direction in (range(upright, len(pitches)), range(upright - 1, -1, -1)):
            self._solve_stand(z, 0.0)
            for j in direction:
                yield j, pitches[j]

    def node(self, z: float, pitch: float) -> PoseNode | None:
        """Return the node, or None if the pose cannot be reached."""
        if not self._solve_stand(z, pitch):
            return None
        kinematics = self.kinematics
        kinematics.update(self._ik.q)
        A = np.vstack((kinematics.J, kinematics.C))
        T = np.asarray(np.linalg.solve(A, np.eye(N_JOINTS)[:, :6]), float)
        hessians = [
            kinematics.hessian_times(self._F_O, force).copy()
            for force in (self._no_assist, self._assist)
        ]
        diagonals = [np.diagonal(self._gains.gains(kinematics, h).K_q) for h in hessians]
        K_q: Array = np.max(diagonals, axis=0)
        fraction = self._config.certificate.k_q_fraction_max
        D_max = np.clip(fraction * K_q[:N_LEG], 0.0, self._config.joint_service.k_p_max)
        return PoseNode(T, (hessians[0], hessians[1]), np.asarray(D_max, float))
