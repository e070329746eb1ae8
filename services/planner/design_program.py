"""Chooses damping and coupling by the dynamic certificate. Offline; run by `xrl gains`.

    minimise    what the hand feels in a squat [N] + SWAY_WEIGHT (slowest decay + DECAY_WANTED)+
    subject to  every condition of `services.planner.dynamic_certificate` fades

over the six local dampings of a leg, and the bandwidth and damping of tau_coupled, all on a
ladder of ratios. Coordinate descent from a stable start: the certificate is evaluated at a few
poses and drivetrains on the way and at all of them at the end. A pose that fails there is added.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

import msgspec
import numpy as np

from services.planner.dynamic_certificate import Design, DynamicCertificate, StiffnessNode
from services.planner.split import CouplingGains
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError

Progress = Callable[[str], None]

STEP: Final = 1.25
"""Ratio of neighbours on the ladders."""
ROUNDS: Final = 3
START: Final = Design((40.0, 30.0, 40.0, 8.0, 40.0, 6.0), CouplingGains(3.0, 1.7))
LEAD_HZ: Final = 0.3
"""Frequency at which the hand's effort is judged: between the squat's 0.2 Hz and a quick
person's."""
LEAD_M_S: Final = 0.15
"""Speed of the hand in the reference squat."""
NOMINAL_STIFFNESS: Final = 8000.0
DECAY_WANTED: Final = 0.6
"""1/s: sway that fades more slowly costs."""
SWAY_WEIGHT: Final = 40.0
"""N per 1/s of missing decay."""


def choose(
    config: RobotConfig, nodes: list[StiffnessNode], progress: Progress = lambda _text: None
) -> Design:
    """Return the design of a robot.

    Args:
        config: the robot.
        nodes: poses of its schedule, with local stiffness.
        progress: told what has been found so far, in words.

    Raises:
        RunError: the robot cannot meet the certificate; says what stands in the way.
    """
    full = DynamicCertificate(config, nodes)
    for verdict, lower in (
        (full.worst_in_hold(START), "the k_d of [stand]"),
        (full.worst_in_track(START), "law.lead_easing or what [robustness] asks for"),
    ):
        if not verdict.stable:
            raise RunError(f"no stable gains: {verdict.words()}; lower {lower}")
    asked = _few(nodes)
    best = START
    while True:
        rough = DynamicCertificate(_rough(config), asked)
        found = _descend(rough, best, progress)
        progress("every pose and drivetrain")
        verdict = full.worst_in_track(found, stop_above=0.0)
        if verdict.stable:
            return found
        if any(node is verdict.condition.node for node in asked):
            return best  # only a drivetrain in between minds: as good as it gets
        asked.append(verdict.condition.node)


def check(
    config: RobotConfig,
    nodes: list[StiffnessNode],
    design: Design,
    progress: Progress = lambda _text: None,
) -> None:
    """Hold a design to the certificate.

    Raises:
        RunError: it is not stable; says where.
    """
    progress("every pose and drivetrain")
    verdict = DynamicCertificate(config, nodes).worst(design)
    if not verdict.stable:
        raise RunError(f"this damping is not stable: {verdict.words()}; run `xrl gains` without it")


def _descend(rough: DynamicCertificate, design: Design, progress: Progress) -> Design:
    """Return the cheapest design that is found from one that is stable."""
    cost = _cost(rough, design)
    for turn in range(ROUNDS):
        before = cost
        for candidate in _neighbours(design):
            wanted = _cost(rough, candidate)
            if wanted < cost - 0.01 and rough.worst_in_track(candidate, stop_above=0.0).stable:
                design, cost = candidate, wanted
                progress(f"damping, round {turn + 1}: hand and sway cost {cost:.1f} N")
        if before - cost < 0.05:
            break
    return design


def _cost(certificate: DynamicCertificate, design: Design) -> float:
    """Return the hand's effort in N, and what slow sway costs beside it."""
    effort = [
        LEAD_M_S * abs(certificate.loop(condition, design).impedance_z(2.0 * math.pi * LEAD_HZ))
        for condition in certificate.led(NOMINAL_STIFFNESS)
    ]
    sway = certificate.sway(design)
    return float(np.mean(effort)) + SWAY_WEIGHT * max(0.0, sway + DECAY_WANTED)


def _neighbours(design: Design) -> Iterator[Design]:
    """Yield designs one step away, each way, of every parameter; of phi also all at once."""
    for ratio in (STEP, 1.0 / STEP):
        for joints in ((0,), (1,), (2,), (3,), (4,), (5,), (0, 2, 4), (3, 5)):
            D_B = tuple(d * ratio if i in joints else d for i, d in enumerate(design.D_B))
            yield design._replace(D_B=D_B)
        bandwidth, damping = design.coupling
        yield design._replace(coupling=CouplingGains(bandwidth * ratio, damping))
        yield design._replace(coupling=CouplingGains(bandwidth, damping * ratio))


def _rough(config: RobotConfig) -> RobotConfig:
    """Return a robot asked about its softest, nominal and stiffest drivetrain only."""
    wanted = config.robustness
    few = sorted({min(wanted.stiffness), NOMINAL_STIFFNESS, max(wanted.stiffness)})
    return msgspec.structs.replace(
        config, robustness=msgspec.structs.replace(wanted, stiffness=tuple(few))
    )


def _few(nodes: list[StiffnessNode]) -> list[StiffnessNode]:
    """Return the lowest, a middle and the highest upright pose, and a pitched one."""
    upright = [node for node in nodes if node.pitch == 0.0]
    pitched = [node for node in nodes if node.pitch > 0.5]
    picked = [upright[0], upright[len(upright) // 2], upright[-1]]
    return picked + ([pitched[len(pitched) // 2]] if pitched else [])
