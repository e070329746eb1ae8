"""Failsafe certificate: the local gains alone hold the robot (docs/law.md#certificate). Pure.

Without the planner, tau = D (q_ref - q) + tau_ff, and both feet stay in place. T (12, 6) contains
the joint rates per unit of p along the closed chain: [J; C] T = [I; 0]. The stiffness along p is
then

    K_fail = sym(T^T D T) + K_geo,    K_geo = T^T H T,
    H = d(J^T F_O + J_harness^T (F_assist + F_load) up)/dq.

K_geo is -d/dp of T^T (tau_ff - torque that balances weight and load), with constant tau_ff. The
robot stands only if K_fail > 0. The margin is the smallest eigenvalue of K_fail, with each
direction scaled by the required stiffness (`certificate.K_required`). At 1 the requirement is met;
at 0 the robot falls.

Tier 3: without its joint service, each motor of a module holds with the mean of the two joints'
stiffnesses (docs/drives.md). So D is averaged per module.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import casadi as ca
import numpy as np

from services.planner.law.small_matrices import eigenvalue_min
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.joints import N_JOINTS
from shared.robot.compiled_graph import CompiledGraph

DIRECTIONS = ("lean forward", "lean sideways", "sink", "roll", "pitch", "yaw")
"""Name of the motion along each row of p."""
UNITS = ("N/m", "N/m", "N/m", "N m/rad", "N m/rad", "N m/rad")


class Margins(NamedTuple):
    """Smallest eigenvalues, as fractions of the required stiffness."""

    service: float
    """Tier 2: the joint services hold."""
    onboard: float
    """Tier 3: the drives' own loops hold."""


class Weakest(NamedTuple):
    """The direction with the smallest margin."""

    direction: str
    margin: float
    stiffness: float
    """Stiffness along that direction, N/m or N m/rad: margin times the required stiffness."""
    required: float
    unit: str
    p: Array
    """Direction (6,), m and rad. Multiplied by the square root of the required stiffness, its
    largest element is 1."""


def motor_mean(D: Array) -> Array:
    """Return D (12,) with each module's two stiffnesses replaced by their mean."""
    mean = np.empty(N_JOINTS)
    mean[0::2] = mean[1::2] = 0.5 * (D[0::2] + D[1::2])
    return mean


def stiffness_graph() -> ca.Function:
    """Return the graph (T, H, D, scale) -> K_fail scaled (6, 12), K_fail (6, 6): docs/law.md (19).

    Columns 0 to 5 of the first result are for tier 2, which holds with D; columns 6 to 11 are for
    tier 3, which holds with each module's mean. The second result is for tier 2, in N/m, N/rad and
    N m/rad.
    """
    T, H = ca.MX.sym("T", N_JOINTS, 6), ca.MX.sym("H", N_JOINTS, N_JOINTS)
    D, scale = ca.MX.sym("D", N_JOINTS), ca.MX.sym("scale", 6)
    pair = ca.DM(0.5 * np.kron(np.eye(N_JOINTS // 2), np.ones((2, 2))))
    scaled = T * ca.repmat(scale.T, N_JOINTS, 1)
    geometric = scaled.T @ H @ scaled
    geometric = 0.5 * (geometric + geometric.T)
    service, onboard = (
        scaled.T @ (ca.repmat(stiffness, 1, 6) * scaled) + geometric
        for stiffness in (D, ca.sparsify(pair) @ D)
    )
    both = ca.horzcat(service, onboard)
    return ca.Function("stiffness", [T, H, D, scale], [both, service / (scale @ scale.T)])


_graph = functools.cache(stiffness_graph)
"""The graph, built once. A decorator on `stiffness_graph` would hide it from mutation tests."""


class Certificate:
    """Certificate at one configuration; `at` sets the configuration."""

    def __init__(self, config: RobotConfig) -> None:
        self.K_required: Array = np.array(config.certificate.K_required)
        self._graph = CompiledGraph(_graph())
        self._T, self._hessian_O, self._D, self._scale = self._graph.arguments
        self._scale[:] = 1.0 / np.sqrt(self.K_required)
        self._K_scaled, self._K_fail = self._graph.results

    def at(self, T: Array, hessian_O: Array) -> None:
        """Set the configuration.

        Args:
            T: joint rates per unit of p along the closed chain (12, 6).
            hessian_O: `Kinematics.hessian_times` of F_O and the force at the harness (12, 12),
                N m/rad.
        """
        self._T[:], self._hessian_O[:] = T, hessian_O

    def margins(self, D: Array) -> Margins:
        """Return the margins of local stiffnesses D (12,), N m/rad.

        Both are zero where the closed chain has no finite rates: no gains are certified there.
        """
        self._evaluate(D)
        K = self._K_scaled
        if not np.isfinite(K).all():
            return Margins(0.0, 0.0)
        return Margins(eigenvalue_min(K[:, :6]), eigenvalue_min(K[:, 6:]))

    def weakest(self, D: Array) -> Weakest:
        """Return the weakest direction under local stiffnesses D (12,), N m/rad."""
        self._evaluate(D)
        values, vectors = np.linalg.eigh(self._K_scaled[:, :6])
        u = vectors[:, 0]
        index = int(np.abs(u).argmax())
        required = float(self.K_required[index])
        return Weakest(
            DIRECTIONS[index],
            float(values[0]),
            float(values[0]) * required,
            required,
            UNITS[index],
            np.asarray(u / u[index] * self._scale, float),
        )

    def failsafe_stiffness(self, D: Array) -> Array:
        """Return K_fail (6, 6) of local stiffnesses D (12,): N/m, N/rad and N m/rad."""
        self._evaluate(D)
        return self._K_fail.copy()

    def _evaluate(self, D: Array) -> None:
        self._D[:] = D
        self._graph()
