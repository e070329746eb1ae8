"""Chooses damping and coupling with the dynamic certificate. Offline; run by `xrl gains`.

    minimise    effort of the hand in a squat [N] + SWAY_WEIGHT (slowest decay + DECAY_WANTED)+
    subject to  every condition of `tools.lab.design.dynamic_certificate` decays

The variables are the six local dampings of a leg, and bandwidth and damping of tau_coupled, all on
a ladder of ratios. The method is coordinate descent from a stable start. Each step evaluates the
certificate at a few poses and drivetrains; the end evaluates all of them. A pose that fails there
is added.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

import msgspec
import numpy as np

from services.planner.law.split import CouplingGains
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.lab.design.dynamic_certificate import (
    HELD,
    TRACK,
    Design,
    DynamicCertificate,
    StiffnessNode,
)

Progress = Callable[[str], None]

STEP: Final = 1.25
"""Ratio between neighbours on the ladders."""
ROUNDS: Final = 3
START: Final = Design((40.0, 30.0, 40.0, 8.0, 40.0, 6.0), CouplingGains(3.0, 2.125))
LEAD_HZ: Final = 0.3
"""Frequency at which the squat's effort is computed: between its 0.2 Hz and a quick person's."""
LEAD_M_S: Final = 0.15
"""Speed of the hand in the reference squat, m/s."""
NOMINAL_STIFFNESS: Final = 8000.0
DECAY_WANTED: Final = 0.6
"""1/s; sway that decays more slowly adds to the cost."""
SWAY_WEIGHT: Final = 40.0
"""N per 1/s of missing decay."""


def choose(
    config: RobotConfig, nodes: list[StiffnessNode], progress: Progress = lambda _text: None
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
    while True:
        reduced = DynamicCertificate(_with_few_drivetrains(config), checked)
        found = _descend(reduced, START, progress)
        progress("checking every pose and drivetrain")
        verdict = full.worst(found, TRACK, stop_above=0.0)
        if verdict.stable:
            return found
        if any(node is verdict.condition.node for node in checked):
            return START  # a drivetrain between the sampled ones fails; START is stable with all
        checked.append(verdict.condition.node)


def check(
    config: RobotConfig,
    nodes: list[StiffnessNode],
    design: Design,
    progress: Progress = lambda _text: None,
) -> None:
    """Check a design against the certificate.

    Raises:
        RunError: it is not stable; names the condition.
    """
    progress("checking every pose and drivetrain")
    verdict = DynamicCertificate(config, nodes).worst(design)
    if not verdict.stable:
        raise RunError(
            f"the given damping is not stable: {verdict.words()}; run `xrl gains` without it"
        )


def _descend(reduced: DynamicCertificate, design: Design, progress: Progress) -> Design:
    """Return the cheapest design found by descent from a stable one."""
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
                progress(f"damping, round {round_index + 1}: hand and sway cost {cost:.1f} N")
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


def _with_few_drivetrains(config: RobotConfig) -> RobotConfig:
    """Return the robot with its softest, nominal and stiffest drivetrain only."""
    robustness = config.robustness
    stiffnesses = sorted({min(robustness.stiffness), NOMINAL_STIFFNESS, max(robustness.stiffness)})
    return msgspec.structs.replace(
        config, robustness=msgspec.structs.replace(robustness, stiffness=tuple(stiffnesses))
    )


def _sample_nodes(nodes: list[StiffnessNode]) -> list[StiffnessNode]:
    """Return the lowest, a middle and the highest upright pose, and a pitched one."""
    upright = [node for node in nodes if node.pitch == 0.0]
    pitched = [node for node in nodes if node.pitch > 0.5]
    picked = [upright[0], upright[len(upright) // 2], upright[-1]]
    return picked + ([pitched[len(pitched) // 2]] if pitched else [])
