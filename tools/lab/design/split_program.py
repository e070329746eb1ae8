"""Computes the certified gain schedule offline (docs/law.md#gain-split).

The grid spans COM height and torso pitch. At each node, the local stiffnesses D of one leg solve a
semidefinite program; the other leg is alike:

    minimise    K_loc[z, z] / 1000 + K_loc[pitch, pitch] / 10 + 1e-3 sum(D)
    subject to  K_loc(D) + K_geo >= diag(K_required)
                K_loc(motor mean of D) + K_geo >= onboard_fraction diag(K_required)
                0 <= D <= k_q_fraction_max diag(K_q)

K_loc = T^T D T, and K_geo is as in `services.planner.law.certificate`. The constraints hold without
and with the full assist. K_geo is linear in the assist, so every assist in between is covered.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from services.planner.law.certificate import Certificate, Margins
from services.planner.law.split import CouplingGains, ScheduledGains
from shared.arrays import Array
from shared.config.gain_schedule import VERSION, digest_of, inputs_of
from shared.config.gain_table import GainSchedule, LegGains
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.extras import late
from shared.joints import N_LEG
from tools.lab.design import design_program
from tools.lab.design.dynamic_certificate import Design, nodes_of
from tools.lab.design.dynamic_certificate import StiffnessNode as DynamicNode
from tools.lab.design.poses import BoundsOverPoses, PoseNode, Poses, geometric_stiffness
from tools.lab.design.push_limit import PushLimits, limits_at, stand_at

if TYPE_CHECKING:
    import cvxpy as cp
else:
    cp = late("cvxpy")

Progress = Callable[[int, int], None]
"""Called with the number of nodes done and their total."""

N_HEIGHTS: Final = 25
DYNAMIC_HEIGHTS: Final = 13
DYNAMIC_PITCHES: Final = (0.0, 1.2)
"""rad"""
PITCHES: Final = (-0.4, 0.0, 0.4, 0.8, 1.2, 1.5)
"""rad"""
FULL_SCALE: Final = 1000.0
"""N m/rad; unit of D in the program, so that the solver works on numbers near 1."""


def solve(
    config: RobotConfig,
    progress: Progress = lambda _done, _of: None,
    report: Callable[[str], None] = lambda _text: None,
    design: Design | None = None,
    *,
    check: bool = True,
) -> GainSchedule:
    """Return the schedule of a robot.

    Args:
        config: the robot.
        progress: called with the poses done and their total.
        report: called with text on the search for damping.
        design: damping and coupling to use; None to search for them.
        check: check a given design against the dynamic certificate.

    Raises:
        RunError: at a pose no local gains meet the certificate; names the pose.
    """
    poses = Poses(config)
    z_nodes = np.linspace(*poses.reach(), N_HEIGHTS)
    found: dict[tuple[int, int], Array] = {}
    bounds = BoundsOverPoses(config)
    done, total = 0, N_HEIGHTS * len(PITCHES)
    for i, z in enumerate(z_nodes):
        for j, pitch in poses.outwards(z, PITCHES):
            node = poses.node(z, pitch)
            if node is not None:
                found[i, j] = _program(config, node, z, pitch)
                bounds.add(poses, node, found[i, j])
        done += len(PITCHES)
        progress(done, total)
    rows = [
        tuple(_rounded(_nearest(found, i, j)) for j in range(len(PITCHES)))
        for i in range(N_HEIGHTS)
    ]
    inputs = inputs_of(config)
    stiffness = GainSchedule(
        version=VERSION,
        digest=digest_of(inputs),
        inputs=inputs,
        z=tuple(round(float(z), 6) for z in z_nodes),
        pitch=PITCHES,
        D=tuple(rows),
        D_B=_rounded(np.zeros(N_LEG)),
        coupling_bandwidth_hz=1.0,
        coupling_damping=0.0,
        lead_easing=config.law.lead_easing,
    )
    if design is None:
        design = design_program.choose(config, dynamic_nodes(config, stiffness), report)
    elif check:
        design_program.check(config, dynamic_nodes(config, stiffness), design, report)
    return msgspec.structs.replace(
        stiffness,
        D_B=_rounded(np.array(design.D_B)),
        coupling_bandwidth_hz=round(design.coupling.bandwidth_hz, 3),
        coupling_damping=round(design.coupling.damping, 3),
        bounds=bounds.by_kind(np.array(design.D_B)),
    )


def dynamic_nodes(config: RobotConfig, schedule: GainSchedule) -> list[DynamicNode]:
    """Return the poses that the dynamic certificate covers."""
    z = np.array(schedule.z)
    heights = z[np.linspace(0, len(z) - 1, DYNAMIC_HEIGHTS).round().astype(int)]
    return nodes_of(config, ScheduledGains(schedule).at, heights, np.array(DYNAMIC_PITCHES))


def design_of(schedule: GainSchedule) -> Design:
    """Return the damping and coupling of a schedule."""
    coupling = CouplingGains(schedule.coupling_bandwidth_hz, schedule.coupling_damping)
    return Design(schedule.D_B, coupling)


def smallest_margins(config: RobotConfig, schedule: GainSchedule) -> Margins:
    """Return the smallest margins at the nodes and half way between them."""
    poses, certificate, scheduled = Poses(config), Certificate(config), ScheduledGains(schedule)
    service = onboard = np.inf
    z_nodes, pitches = np.array(schedule.z), np.array(schedule.pitch)
    for z in _with_midpoints(z_nodes):
        for pitch in _with_midpoints(pitches):
            node = poses.node(z, pitch)
            for hessian in node.hessians if node is not None else ():
                assert node is not None  # noqa: S101 - for the type checker
                certificate.at(node.T, hessian)
                margins = certificate.margins(scheduled.at(z, pitch))
                service = min(service, margins.service)
                onboard = min(onboard, margins.onboard)
    return Margins(service, onboard)


def push_limits(config: RobotConfig, heights: int) -> Iterator[tuple[float, dict[str, PushLimits]]]:
    """Yield COM heights, m, over the schedule's range, and the push limits there, upright."""
    schedule = config.gain_schedule
    assert schedule is not None  # noqa: S101 - the caller has just computed it
    poses, scheduled = Poses(config), ScheduledGains(schedule)
    for z in np.linspace(schedule.z[0], schedule.z[-1], heights):
        stand = stand_at(config, poses, float(z), 0.0)
        if stand is not None:
            D = scheduled.at(float(z), 0.0)
            yield float(z), limits_at(stand, config, D, scheduled.D_B)


def _with_midpoints(nodes: Array) -> Array:
    return np.sort(np.concatenate((nodes, 0.5 * (nodes[1:] + nodes[:-1]))))


def _program(config: RobotConfig, node: PoseNode, z: float, pitch: float) -> Array:
    """Return D of one leg (6,), N m/rad, at a node."""
    K_required = np.array(config.certificate.K_required)
    T = node.T / np.sqrt(K_required)
    per_joint = [np.outer(T[i], T[i]) + np.outer(T[i + N_LEG], T[i + N_LEG]) for i in range(N_LEG)]
    D = cp.Variable(N_LEG, nonneg=True)
    mean = np.kron(np.eye(N_LEG // 2), np.full((2, 2), 0.5))
    K_loc = _weighted_sum(per_joint, FULL_SCALE * D)
    K_onboard = _weighted_sum(per_joint, FULL_SCALE * (mean @ D))
    constraints = [node.D_max / FULL_SCALE >= D]
    for hessian in node.hessians:
        K_geo = geometric_stiffness(T, hessian)
        constraints += [
            K_loc + K_geo >> np.eye(6),
            K_onboard + K_geo >> config.certificate.onboard_fraction * np.eye(6),
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
            # the certificate judges an inaccurate solution, not the solver's warning
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise RunError(f"{where}: the solver failed: {error}") from None
    if problem.status == cp.settings.USER_LIMIT:  # there are values, and they are no solution
        raise RunError(
            f"{where}: the solver stopped at its iteration limit; "
            "check the values of [certificate] and [law] in the robot file"
        )
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise RunError(
            f"{where}: no local gains meet the certificate ({problem.status}); "
            "lower certificate.K_required, or raise certificate.k_q_fraction_max or law.K_p"
        )
    return np.asarray(np.clip(FULL_SCALE * D.value, 0.0, node.D_max), float)


def _weighted_sum(matrices: list[Array], weights: cp.Expression) -> cp.Expression:
    return sum(weights[i] * matrix for i, matrix in enumerate(matrices))


def _nearest(found: dict[tuple[int, int], Array], i: int, j: int) -> Array:
    """Return D of a node, or of the reachable node closest in pitch at the same height."""
    at_height = {b: D for (a, b), D in found.items() if a == i}
    return at_height[min(at_height, key=lambda b: (abs(b - j), b))]


def _rounded(D: Array) -> LegGains:
    a, b, c, d, e, f = (round(float(value), 3) for value in D)
    return a, b, c, d, e, f
