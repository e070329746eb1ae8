"""Computes standing poses over COM height and pitch, for the certificates and the command bounds.

Runs offline. The joint services check commands against the bounds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from services.planner.law.kinematics import Kinematics
from services.planner.law.split import GainLaw
from shared.arrays import Array
from shared.config.gain_table import Bounds, ModuleBounds
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULES, N_JOINTS, N_LEG, kind_of
from shared.robot.robot_model import stand_pose
from tools.reach import ReachSolver

REACH_STEP: Final = 0.005
"""m; resolution of the ends of the height range."""
MID_HEIGHT_FRACTION: Final = 0.8
"""Height of the first pose, as a fraction of the straight leg."""

BODY_RATES: Final = (0.3, 0.3, 1.0, 0.5, 2.0, 0.5)
"""Maximum rates along p, m/s and rad/s; a faster motion is a fall. A person leads a squat at up
to 0.3 m/s."""
THETA_BINS: Final = 12
"""Number of bins over a joint's range of theta."""
KINDS: Final = {kind_of(module): 2 * i for i, module in enumerate(MODULES[: N_LEG // 2])}
"""Index of a kind's phi in a leg."""


class PoseNode(NamedTuple):
    """Inputs of the certificate at a pose."""

    T: Array
    """(12, 6)"""
    hessians: tuple[Array, Array]
    """`hessian_times` without and with the full assist (12, 12), N m/rad."""
    D_max: Array
    """(6,) N m/rad"""


def geometric_stiffness(T: Array, H: Array) -> Array:
    """Return K_geo (6, 6) of T (12, 6) and H (12, 12), as in `services.planner.law.certificate`."""
    K_geo = T.T @ H @ T
    return np.asarray(0.5 * (K_geo + K_geo.T), float)


class Poses:
    """Upright and pitched stands of a robot, COM over the ankles."""

    def __init__(self, config: RobotConfig) -> None:
        """Start in the middle of the height range."""
        self._config = config
        self.kinematics = Kinematics(config)
        """Updated at the last pose."""
        self._ik = ReachSolver(self.kinematics, np.array(config.joint_limits()))
        self._gains = GainLaw(config)
        self.F_O: Array = np.zeros(6)
        """The weight (6,), N and N m."""
        self.F_O[2] = config.total_mass * GRAVITY
        self.F_assist: Array = np.array([0.0, 0.0, config.assist.force_max])
        """The full assist (3,), N."""
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
        return self.node_at(self._ik.q) if self._solve_stand(z, pitch) else None

    def node_at(self, q: Array) -> PoseNode:
        """Return the node of joint angles (12,), rad, at which the legs agree."""
        kinematics = self.kinematics
        kinematics.update(q)
        A = np.vstack((kinematics.J, kinematics.C))
        T = np.asarray(np.linalg.solve(A, np.eye(N_JOINTS)[:, :6]), float)
        hessians = [
            kinematics.hessian_times(self.F_O, force).copy()
            for force in (np.zeros(3), self.F_assist)
        ]
        diagonals = [np.diagonal(self._gains.gains(kinematics, h).K_q) for h in hessians]
        K_q: Array = np.max(diagonals, axis=0)
        fraction = self._config.certificate.k_q_fraction_max
        D_max = np.clip(fraction * K_q[:N_LEG], 0.0, self._config.joint_service.k_p_max)
        return PoseNode(T, (hessians[0], hessians[1]), np.asarray(D_max, float))


class BoundsOverPoses:
    """Collects the command bounds, equal for both legs, while the schedule is computed."""

    def __init__(self, config: RobotConfig) -> None:
        right = MODULES[: N_LEG // 2]
        self._stand_k_p = np.ravel([config.stand_gains(module).k_p for module in right])
        self._k_p: list[Array] = []
        self._k_p_max: list[Array] = []
        self._q: list[Array] = []
        self._tau_ff: list[Array] = []
        self._v_ref: list[Array] = []

    def add(self, poses: Poses, node: PoseNode, D: Array) -> None:
        """Add a node, the pose last solved by `poses`, with its local stiffness D (6,), N m/rad."""
        q, kinematics = poses.q, poses.kinematics
        self._k_p.append(D)
        self._k_p_max.append(node.D_max)
        weight = poses.F_O @ kinematics.J
        for tau in (weight, weight + poses.F_assist @ kinematics.J_harness):
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
        """Return the bounds of tau_ff per bin of theta, each including its neighbouring bins."""
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
