"""Between which the law's commands lie, over all poses: what a joint may believe. Offline."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.planner.kinematics import Kinematics
from services.planner.poses import PoseNode
from shared.config import GRAVITY, RobotConfig
from shared.gain_table import Bounds, ModuleBounds
from shared.joints import MODULES, N_LEG, kind_of

Array = NDArray[np.float64]

BODY_RATES: Final = (0.3, 0.3, 1.0, 0.5, 2.0, 0.5)
"""m/s and rad/s along p: faster is no lead but a fall. A squat that is led has 0.3 m/s."""
PARTS: Final = 12
"""Into how many a joint's range of theta is divided."""
KINDS: Final = {kind_of(module): 2 * i for i, module in enumerate(MODULES[: N_LEG // 2])}
"""Where a kind's phi stands in a leg."""


class BoundsOverPoses:
    """Gathers the bounds while the schedule is made; both legs are alike."""

    def __init__(self, config: RobotConfig) -> None:
        """Begin with nothing but the stand gains."""
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
        """Take a pose.

        Args:
            q: joint angles (12,), rad.
            kinematics: updated there.
            node: what the certificate needs of it.
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
        """Return the bounds; `D_B` (6,) is the local damping, N m s/rad."""
        k_p_low = np.min(self._k_p, axis=0)
        k_p_high = np.max([*self._k_p_max, self._stand_k_p], axis=0)
        v_ref = np.max(self._v_ref, axis=0)
        return {
            kind: ModuleBounds(
                k_p=_bounds(k_p_low, k_p_high, at),
                k_d=_bounds(D_B, D_B, at),
                theta=_rounded(np.array(self._q)[:, at + 1]),
                tau_ff=self._by_theta(at),
                v_ref=(round(float(v_ref[at]), 3), round(float(v_ref[at + 1]), 3)),
            )
            for kind, at in KINDS.items()
        }

    def _by_theta(self, at: int) -> tuple[Bounds, ...]:
        """Return the bounds of tau_ff over the joint's own theta, each with those beside it."""
        theta, tau = np.array(self._q)[:, at + 1], np.array(self._tau_ff)
        edges = np.linspace(*_rounded(theta), PARTS + 1)
        width = edges[1] - edges[0]
        rows = []
        for middle in edges[:-1] + 0.5 * width:
            away = np.abs(theta - middle)
            near = tau[away <= max(1.5 * width, float(away.min()))]
            rows.append(_bounds(near.min(axis=0), near.max(axis=0), at))
        return tuple(rows)


def _rounded(theta: Array) -> tuple[float, float]:
    return round(float(theta.min()), 3), round(float(theta.max()), 3)


def _bounds(low: Array, high: Array, at: int) -> Bounds:
    a, b, c, d = (round(float(row[at + axis]), 3) for row in (low, high) for axis in (0, 1))
    return (a, b), (c, d)
