"""Computes joint stiffness and damping of the whole body (paper section III). Pure.

K_q = N K_0 + J^T K_p J - sum_i H_i F_i, B_q = N B_0 + J^T B_p J, N = I - J^+ J.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from services.planner.law.kinematics import Kinematics
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.joints import N_JOINTS


class JointGains(NamedTuple):
    """Whole-body joint gains."""

    K_q: Array
    """(12, 12) N m/rad, symmetric."""
    B_q: Array
    """(12, 12) N m s/rad, symmetric."""


class GainLaw:
    """Gains at one configuration."""

    def __init__(self, config: RobotConfig) -> None:
        """Filter K_p and B_p by S_perp: no stiffness in the directions that the operator leads."""
        law = config.law
        self.S: Array = np.array(law.S, dtype=float)
        closed = 1.0 - self.S
        self.K_p: Array = np.array(law.K_p) * closed
        self.B_p: Array = np.array(law.B_p) * closed
        self._K_0, self._B_0 = law.K_0, law.B_0
        self._damping = law.damping_lambda**2 * np.eye(6)
        self._identity = np.eye(N_JOINTS)

    def gains(self, kinematics: Kinematics, hessian_F: Array) -> JointGains:
        """Return the gains: docs/law.md (10) and (11).

        Args:
            kinematics: updated at the configuration.
            hessian_F: sum_i H_i F_i (12, 12), N m/rad.
        """
        J = kinematics.J
        # damped, because the plain pseudo-inverse jumps at a straight knee
        N = self._identity - J.T @ np.linalg.solve(J @ J.T + self._damping, J)
        K_q = self._K_0 * N + (J.T * self.K_p) @ J - hessian_F
        B_q = self._B_0 * N + (J.T * self.B_p) @ J
        return JointGains(0.5 * (K_q + K_q.T), 0.5 * (B_q + B_q.T))
