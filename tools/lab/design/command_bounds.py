"""Bounds of the law's commands over all poses, for the check in the joint services. Offline."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.planner.law.kinematics import Kinematics
from shared.config.gain_table import Bounds, ModuleBounds
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULES, N_LEG, kind_of
from tools.lab.design.poses import PoseNode

Array = NDArray[np.float64]

BODY_RATES: Final = (0.3, 0.3, 1.0, 0.5, 2.0, 0.5)
"""m/s and rad/s along p; a faster motion is no lead but a fall. A squat led by a person has 0.3
m/s."""
THETA_BINS: Final = 12
"""Bins of a joint's range of theta."""
KINDS: Final = {kind_of(module): 2 * i for i, module in enumerate(MODULES[: N_LEG // 2])}
"""Index of a kind's phi in a leg."""


class BoundsOverPoses:
    """Collects the bounds while the schedule is computed; both legs are alike."""

    def __init__(self, config: RobotConfig) -> None:
        """Start with the stand gains only."""
        self._F_O: Array = np.zeros(6)
        self._F_O[2] = config.total_mass * GRAVITY
        self._assist: Array = np.array([0.0, 0.0, config.assist.force_max])
        right = MODULES[: N_LEG // 2]
        self._stand_k_p = np.ravel([config.stand_gains(module).k_p for module in right])
        self._k_p: list[Array] = []
        self._k_p_max: list[Array] = []
        self._q: list[Array] = []
        self._tau_ff: list[Array] = []
        self._v_ref: list[Array] = []

    def add(self, q: Array, kinematics: Kinematics, node: PoseNode, D: Array) -> None:
        """Add a pose.

        Args:
            q: joint angles (12,), rad.
            kinematics: updated at the pose.
            node: inputs of the certificate at the pose.
            D: local stiffness (6,), N m/rad.
        """
        self._k_p.append(D)
        self._k_p_max.append(node.D_max)
        weight = self._F_O @ kinematics.J
        for tau in (weight, weight + self._assist @ kinematics.J_harness):
            self._tau_ff += [tau[:N_LEG].copy(), tau[N_LEG:].copy()]
            self._q += [q[:N_LEG], q[N_LEG:]]
        rates = np.abs(node.T) @ np.array(BODY_RATES)
        self._v_ref += [rates[:N_LEG], rates[N_LEG:]]

    def by_kind(self, D_B: Array) -> dict[str, ModuleBounds]:
        """Return the bounds per kind of module; `D_B` (6,) is the local damping, N m s/rad."""
        k_p_low = np.min(self._k_p, axis=0)
        k_p_high = np.max([*self._k_p_max, self._stand_k_p], axis=0)
        v_ref = np.max(self._v_ref, axis=0)
        return {
            kind: ModuleBounds(
                k_p=_bounds(k_p_low, k_p_high, column),
                k_d=_bounds(D_B, D_B, column),
                theta=_rounded(np.array(self._q)[:, column + 1]),
                tau_ff=self._by_theta(column),
                v_ref=(round(float(v_ref[column]), 3), round(float(v_ref[column + 1]), 3)),
            )
            for kind, column in KINDS.items()
        }

    def _by_theta(self, column: int) -> tuple[Bounds, ...]:
        """Return the bounds of tau_ff per bin of theta, each including the bins beside it."""
        theta, tau = np.array(self._q)[:, column + 1], np.array(self._tau_ff)
        edges = np.linspace(*_rounded(theta), THETA_BINS + 1)
        width = edges[1] - edges[0]
        bounds = []
        for middle in edges[:-1] + 0.5 * width:
            distance = np.abs(theta - middle)
            tau_close = tau[distance <= max(1.5 * width, float(distance.min()))]
            bounds.append(_bounds(tau_close.min(axis=0), tau_close.max(axis=0), column))
        return tuple(bounds)


def _rounded(theta: Array) -> tuple[float, float]:
    return round(float(theta.min()), 3), round(float(theta.max()), 3)


def _bounds(low: Array, high: Array, column: int) -> Bounds:
    a, b, c, d = (round(float(row[column + axis]), 3) for row in (low, high) for axis in (0, 1))
    return (a, b), (c, d)
