"""The certified gain schedule, computed offline (design section 3 c).

At each node of a grid over COM height and torso pitch, the local stiffnesses D of one leg
(the other is alike) solve a semidefinite program:

    minimise    K_loc[z, z] / 1000 + K_loc[pitch, pitch] / 10 + 1e-3 sum(D)
    subject to  K_loc(D) + K_geo >= diag(K_required)
                K_loc(motor mean of D) + K_geo >= onboard_share diag(K_required)
                0 <= D <= k_q_share_max diag(K_q)

K_loc = T^T D T, K_geo as in `services.planner.certificate`, both without and with the full
assist (K_geo is linear in it, so every assist in between is covered).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from services.planner.certificate import Certificate, Margins
from services.planner.gains import GainLaw
from services.planner.inverse_kinematics import InverseKinematics
from services.planner.kinematics import Kinematics
from services.planner.split import ScheduledGains
from shared.config import GRAVITY, RobotConfig
from shared.config_sections import GainSchedule, LegGains
from shared.exceptions import RunError
from shared.gain_schedule import VERSION, digest_of, inputs_of
from shared.joints import N_JOINTS, N_LEG
from shared.robot_model import stand_pose

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Told how many nodes are done, of how many."""

N_HEIGHTS: Final = 25
PITCHES: Final = (-0.4, 0.0, 0.4, 0.8, 1.2, 1.5)
"""rad"""
REACH_STEP: Final = 0.005
"""m; how finely the ends of the height range are told."""
MID_HEIGHT: Final = 0.8
"""Of the straight leg: a stand from where every other pose is walked to."""
FULL_SCALE: Final = 1000.0
"""N m/rad; D in the program is in units of this, so that the solver sees numbers near 1."""


class Node(NamedTuple):
    """The certificate's ingredients at a pose."""

    T: Array
    """(12, 6)"""
    hessians: tuple[Array, Array]
    """`hessian_times` without and with the full assist (12, 12), N m/rad."""
    D_max: Array
    """(6,) N m/rad"""


def solve(config: RobotConfig, progress: Progress = lambda _done, _of: None) -> GainSchedule:
    """Return the schedule of a robot.

    Raises:
        RunError: at a pose no local gains meet the certificate; says which.
    """
    poses = _Poses(config)
    z_nodes = np.linspace(*poses.reach(), N_HEIGHTS)
    found: dict[tuple[int, int], Array] = {}
    done, total = 0, N_HEIGHTS * len(PITCHES)
    for i, z in enumerate(z_nodes):
        for j, pitch in poses.outwards(z):
            node = poses.node(z, pitch)
            if node is not None:
                found[i, j] = _program(config, node, z, pitch)
        done += len(PITCHES)
        progress(done, total)
    rows = [
        tuple(_rounded(_nearest(found, i, j)) for j in range(len(PITCHES)))
        for i in range(N_HEIGHTS)
    ]
    inputs = inputs_of(config)
    return GainSchedule(
        version=VERSION,
        digest=digest_of(inputs),
        inputs=inputs,
        z=tuple(round(float(z), 6) for z in z_nodes),
        pitch=PITCHES,
        D=tuple(rows),
    )


def smallest_margins(config: RobotConfig, schedule: GainSchedule) -> Margins:
    """Return the smallest margins at the nodes and half way between them.

    Args:
        config: the robot.
        schedule: to be checked.
    """
    poses, certificate, scheduled = _Poses(config), Certificate(config), ScheduledGains(schedule)
    service = onboard = np.inf
    z_nodes, pitches = np.array(schedule.z), np.array(schedule.pitch)
    for z in _with_middles(z_nodes):
        for pitch in _with_middles(pitches):
            node = poses.node(z, pitch)
            for hessian in node.hessians if node is not None else ():
                assert node is not None  # noqa: S101 - for the type checker
                certificate.at(node.T, hessian)
                margins = certificate.margins(scheduled.at(z, pitch))
                service = min(service, margins.service)
                onboard = min(onboard, margins.onboard)
    return Margins(service, onboard)


def _with_middles(nodes: Array) -> Array:
    return np.sort(np.concatenate((nodes, 0.5 * (nodes[1:] + nodes[:-1]))))


class _Poses:
    """Upright and pitched stands of a robot, COM over the ankles."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._kinematics = Kinematics(config)
        self._ik = InverseKinematics(self._kinematics, np.array(config.joint_limits()))
        self._gains = GainLaw(config)
        self._F_O: Array = np.zeros(6)
        self._F_O[2] = config.total_mass * GRAVITY
        self._no_assist, self._assist = np.zeros(3), np.array([0.0, 0.0, config.assist.force_max])
        reach = config.geometry.l1 + config.geometry.l2
        self._ik.q[:] = stand_pose(config, MID_HEIGHT * reach)
        self._kinematics.update(self._ik.q)
        self._middle = float(self._kinematics.p[2])

    def _stands(self, z: float, pitch: float) -> bool:
        """Walk to a pose; return False, the last pose kept, if it cannot be reached."""
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
            self._stands(z, 0.0)
            while self._stands(z + step, 0.0):
                z += step
            ends.append(z)
        return ends[0], ends[1]

    def outwards(self, z: float) -> Iterator[tuple[int, float]]:
        """Yield (index, pitch), each next to one before it, from upright on."""
        upright = PITCHES.index(0.0)
        for direction in (range(upright, len(PITCHES)), range(upright - 1, -1, -1)):
            self._stands(z, 0.0)
            for j in direction:
                yield j, PITCHES[j]

    def node(self, z: float, pitch: float) -> Node | None:
        """Return the node, or None if the pose cannot be reached."""
        if not self._stands(z, pitch):
            return None
        kinematics = self._kinematics
        kinematics.update(self._ik.q)
        A = np.vstack((kinematics.J, kinematics.C))
        T = np.asarray(np.linalg.solve(A, np.eye(N_JOINTS)[:, :6]), float)
        hessians = [
            kinematics.hessian_times(self._F_O, force).copy()
            for force in (self._no_assist, self._assist)
        ]
        diagonals = [np.diagonal(self._gains.gains(kinematics, h).K_q) for h in hessians]
        K_q: Array = np.max(diagonals, axis=0)
        share = self._config.certificate.k_q_share_max
        D_max = np.clip(share * K_q[:N_LEG], 0.0, self._config.joint_service.k_p_max)
        return Node(T, (hessians[0], hessians[1]), np.asarray(D_max, float))


def _program(config: RobotConfig, node: Node, z: float, pitch: float) -> Array:
    """Return D of one leg (6,), N m/rad, at a node.

    Raises:
        RunError: there is none.
    """
    K_required = np.array(config.certificate.K_required)
    T = node.T / np.sqrt(K_required)
    of_joint = [np.outer(T[i], T[i]) + np.outer(T[i + N_LEG], T[i + N_LEG]) for i in range(N_LEG)]
    D = cp.Variable(N_LEG, nonneg=True)
    mean = np.kron(np.eye(N_LEG // 2), np.full((2, 2), 0.5))
    K_loc = _weighted_sum(of_joint, FULL_SCALE * D)
    K_onboard = _weighted_sum(of_joint, FULL_SCALE * (mean @ D))
    constraints = [node.D_max / FULL_SCALE >= D]
    for hessian in node.hessians:
        K_geo = T.T @ hessian @ T
        K_geo = 0.5 * (K_geo + K_geo.T)
        constraints += [
            K_loc + K_geo >> np.eye(6),
            K_onboard + K_geo >> config.certificate.onboard_share * np.eye(6),
        ]
    cost = (
        K_loc[2, 2] * K_required[2] / 1e3
        + K_loc[4, 4] * K_required[4] / 10.0
        + 1e-3 * 2.0 * FULL_SCALE * cp.sum(D)
    )
    problem = cp.Problem(cp.Minimize(cost), constraints)
    where = f"COM height {z:.3f} m, pitch {pitch:.2f} rad"
    try:
        with warnings.catch_warnings():
            # an inaccurate solution is judged by its certificate, not by the solver's doubts
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise RunError(f"{where}: the solver failed: {error}") from None
    if D.value is None:
        raise RunError(
            f"{where}: no local gains meet the certificate ({problem.status}); "
            "lower certificate.K_required, or raise certificate.k_q_share_max or law.K_p"
        )
    return np.asarray(np.clip(FULL_SCALE * D.value, 0.0, node.D_max), float)


def _weighted_sum(matrices: list[Array], weights: cp.Expression) -> cp.Expression:
    return sum(weights[i] * matrix for i, matrix in enumerate(matrices))


def _nearest(found: dict[tuple[int, int], Array], i: int, j: int) -> Array:
    """Return D of a node, or of the reachable one nearest in pitch at the same height."""
    at_height = {b: D for (a, b), D in found.items() if a == i}
    return at_height[min(at_height, key=lambda b: (abs(b - j), b))]


def _rounded(D: Array) -> LegGains:
    a, b, c, d, e, f = (round(float(value), 3) for value in D)
    return a, b, c, d, e, f
