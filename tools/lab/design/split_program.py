"""Computes the certified gain schedule offline, for `xrl gains` (docs/law.md#gain-split).

The grid spans COM height and torso pitch. At each node, the local stiffnesses D of one leg solve a
semidefinite program; the other leg is alike:

    minimise    K_loc[z, z] / 1000 + K_loc[pitch, pitch] / 10 + 1e-3 sum(D)
    subject to  K_loc(D) + K_geo >= diag(K_required)
                K_loc(motor mean of D) + K_geo >= onboard_fraction diag(K_required)
                0 <= D <= k_q_fraction_max diag(K_q)

K_loc = T^T D T, and K_geo is as in `services.planner.law.certificate`. The constraints hold without
and with the full assist. K_geo is linear in the assist, so every assist in between is covered.

Damping and coupling are chosen with the dynamic certificate, one set for all nodes:

    minimise    effort of the hand in a squat [N] + SWAY_WEIGHT (rate of sway + DECAY_WANTED)+
    subject to  every TRACK condition of `tools.lab.design.dynamic_certificate`

The rate of sway, 1/s, is negative if the sway decays. The variables are the six local dampings of
a leg, and bandwidth and damping of tau_coupled, all on a ladder of ratios. The method is coordinate
descent from a stable start. Each step evaluates the certificate at a few poses and drivetrains; the
final check covers all of them. A pose that fails this check is added to the few, and the descent
starts again.
"""

from __future__ import annotations

import math
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
from tools.lab.design.dynamic_certificate import (
    HELD,
    TRACK,
    Design,
    DynamicCertificate,
    StiffnessNode,
    nodes_of,
)
from tools.lab.design.poses import BoundsOverPoses, PoseNode, Poses, geometric_stiffness

if TYPE_CHECKING:
    import cvxpy as cp
else:
    cp = late("cvxpy")

Progress = Callable[[int, int], None]
"""Called with the number of nodes that are done, and their total."""
Report = Callable[[str], None]
"""Called with progress messages of the search for damping."""

N_HEIGHTS: Final = 25
DYNAMIC_HEIGHTS: Final = 13
DYNAMIC_PITCHES: Final = (0.0, 1.2)
"""rad"""
PITCHES: Final = (-0.4, 0.0, 0.4, 0.8, 1.2, 1.5)
"""rad"""
FULL_SCALE: Final = 1000.0
"""N m/rad; unit of D in the program, so that the solver works on numbers near 1."""
STEP: Final = 1.25
"""Ratio between neighbours on the ladders."""
ROUNDS: Final = 3
START: Final = Design((40.0, 30.0, 40.0, 8.0, 40.0, 6.0), CouplingGains(3.0, 2.125))
LEAD_HZ: Final = 0.3
"""Frequency at which the effort is computed: between the squat's 0.2 Hz and a quick person's."""
LEAD_M_S: Final = 0.15
"""Speed of the hand in the reference squat, m/s."""
NOMINAL_STIFFNESS: Final = 8000.0
DECAY_WANTED: Final = 0.6
"""Slowest decay of sway that adds no cost, 1/s."""
SWAY_WEIGHT: Final = 40.0
"""Cost of missing decay, N per 1/s."""


def solve(
    config: RobotConfig,
    progress: Progress = lambda _done, _of: None,
    report: Report = lambda _text: None,
    design: Design | None = None,
    *,
    check: bool = True,
) -> GainSchedule:
    """Return the schedule of a robot.

    If a design is given, it is used; `check` decides whether it must first meet the dynamic
    certificate. Otherwise the function searches for one.

    Raises:
        RunError: no gains meet a certificate; names the pose or the condition.
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
        design = _choose_design(config, dynamic_nodes(config, stiffness), report)
    elif check:
        check_design(config, dynamic_nodes(config, stiffness), design, report)
    return msgspec.structs.replace(
        stiffness,
        D_B=_rounded(np.array(design.D_B)),
        coupling_bandwidth_hz=round(design.coupling.bandwidth_hz, 3),
        coupling_damping=round(design.coupling.damping, 3),
        bounds=bounds.by_kind(np.array(design.D_B)),
    )


def dynamic_nodes(config: RobotConfig, schedule: GainSchedule) -> list[StiffnessNode]:
    """Return the poses that the dynamic certificate covers."""
    z = np.array(schedule.z)
    heights = z[np.linspace(0, len(z) - 1, DYNAMIC_HEIGHTS).round().astype(int)]
    return nodes_of(config, ScheduledGains(schedule).at, heights, np.array(DYNAMIC_PITCHES))


def design_of(schedule: GainSchedule) -> Design:
    """Return the damping and coupling of a schedule."""
    coupling = CouplingGains(schedule.coupling_bandwidth_hz, schedule.coupling_damping)
    return Design(schedule.D_B, coupling)


def smallest_margins(config: RobotConfig, schedule: GainSchedule) -> Margins:
    """Return the smallest margins at the nodes and halfway between them."""
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
            # the certificate judges an inaccurate solution; the solver's warning is not needed
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise RunError(
            f"{where}: the solver failed: {error}; "
            "check the values of [certificate] and [law] in the robot file"
        ) from None
    if problem.status == cp.settings.USER_LIMIT:  # there are values, but not a solution
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


def _choose_design(
    config: RobotConfig, nodes: list[StiffnessNode], report: Report = lambda _text: None
) -> Design:
    """Return the design of a robot, from the poses of its schedule.

    Raises:
        RunError: the robot cannot meet the certificate; names the failing condition.
    """
    full = DynamicCertificate(config, nodes)
    for verdict, lower in (
        (full.worst(START, HELD), "the k_d of [stand]"),
        (full.worst(START, TRACK), "law.lead_easing or the requirements of [robustness]"),
    ):
        if not verdict.stable:
            raise RunError(f"no stable gains found: {verdict.words()}; lower {lower}")
    checked = _sample_nodes(nodes)
    wanted = config.robustness
    few = sorted({min(wanted.stiffness), NOMINAL_STIFFNESS, max(wanted.stiffness)})
    wanted = msgspec.structs.replace(wanted, stiffness=tuple(few))
    with_few_drivetrains = msgspec.structs.replace(config, robustness=wanted)
    while True:
        reduced = DynamicCertificate(with_few_drivetrains, checked)
        found = _descend(reduced, START, report)
        report("checking every pose and drivetrain")
        verdict = full.worst(found, TRACK, stop_above=0.0)
        if verdict.stable:
            return found
        if any(node is verdict.condition.node for node in checked):
            return START  # a drivetrain that was not sampled fails; START is stable with all
        checked.append(verdict.condition.node)


def check_design(
    config: RobotConfig,
    nodes: list[StiffnessNode],
    design: Design,
    report: Report = lambda _text: None,
) -> None:
    """Check a design against the certificate.

    Raises:
        RunError: the design is not stable; names the condition.
    """
    report("checking every pose and drivetrain")
    verdict = DynamicCertificate(config, nodes).worst(design)
    if not verdict.stable:
        raise RunError(
            f"the given damping is not stable: {verdict.words()}; "
            "run `xrl gains` without --damping-of"
        )


def _descend(reduced: DynamicCertificate, design: Design, report: Report) -> Design:
    """Return the cheapest design that a descent from a stable one finds."""
    cost = _cost(reduced, design)
    for round_index in range(ROUNDS):
        before = cost
        for candidate in _neighbours(design):
            candidate_cost = _cost(reduced, candidate)
            if (
                candidate_cost < cost - 0.01
                and reduced.worst(candidate, TRACK, stop_above=0.0).stable
            ):
                design, cost = candidate, candidate_cost
                report(f"damping, round {round_index + 1}: hand and sway cost {cost:.1f} N")
        if before - cost < 0.05:
            break
    return design


def _cost(certificate: DynamicCertificate, design: Design) -> float:
    """Return the hand's effort plus the cost of slow sway, N."""
    effort = [
        LEAD_M_S * abs(certificate.loop(condition, design).impedance_z(2.0 * math.pi * LEAD_HZ))
        for condition in certificate.led(NOMINAL_STIFFNESS)
    ]
    sway = certificate.sway(design)
    return float(np.mean(effort)) + SWAY_WEIGHT * max(0.0, sway + DECAY_WANTED)


def _neighbours(design: Design) -> Iterator[Design]:
    """Yield designs one step up or down in each parameter, in all phi, and in two theta."""
    for ratio in (STEP, 1.0 / STEP):
        for joints in ((0,), (1,), (2,), (3,), (4,), (5,), (0, 2, 4), (3, 5)):
            D_B = tuple(d * ratio if i in joints else d for i, d in enumerate(design.D_B))
            yield design._replace(D_B=D_B)
        bandwidth, damping = design.coupling
        yield design._replace(coupling=CouplingGains(bandwidth * ratio, damping))
        yield design._replace(coupling=CouplingGains(bandwidth, damping * ratio))


def _sample_nodes(nodes: list[StiffnessNode]) -> list[StiffnessNode]:
    """Return the lowest, a middle and the highest upright pose, and a pitched one."""
    upright = [node for node in nodes if node.pitch == 0.0]
    pitched = [node for node in nodes if node.pitch > 0.5]
    picked = [upright[0], upright[len(upright) // 2], upright[-1]]
    return picked + ([pitched[len(pitched) // 2]] if pitched else [])
