"""Drawn loads, frictions, hands and repairs between two power-ups of a robot that hangs.

The robot's legs are not those of its robot file: masses, their centres, stops and friction are
drawn. Statics are written for small angles of thigh and shin, apart from the law's.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from services.joint.differential import motor_from_joint
from shared.arrays import Array
from shared.bus.messages import Pair
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULES, SIDES, kind_of, side_of
from tools.bringup.hanging_leg import Upright
from tools.bringup.whole_turns import MEASURED, ModuleEvidence

EVENTS: Final = (
    "nothing", "nothing", "payload", "leg by hand", "both legs by hand", "power cut at work",
    "encoder exchanged", "board exchanged", "magnet slipped", "cables swapped", "leans", "jammed",
)  # fmt: skip
REPAIRS: Final = ("encoder exchanged", "board exchanged", "cables swapped")
NO_SWING: Final = ((0.0, 0.0), (0.0, 0.0))
UP: Final = np.array([0.0, 0.0, 1.0])
STRANGER: Final = "its board or encoder is another"


class PowerCycle(NamedTuple):
    """What is known after a power-up, and the truth."""

    event: str
    evidence: dict[str, ModuleEvidence]
    upright: Upright
    truth: dict[str, Pair]


class Leg(NamedTuple):
    """A leg as it is, in place of the robot file's."""

    k_thigh: float
    """N m/rad"""
    k_shin: float
    thigh_off: Array
    """(phi, theta) at which thigh and shin alone hang, rad."""
    shin_off: Array
    stop: float
    """The knee's mechanical stop in theta, rad."""
    friction: Array
    """(4,): of knee and hip, phi and theta, N m."""


def drawn_leg(rng: np.random.Generator, robot: RobotConfig, friction: float) -> Leg:
    """Return a leg whose masses, centres, stop and friction are drawn."""
    geometry, weight = robot.geometry, robot.mass.module * GRAVITY
    stiff = rng.random() < 0.05  # a gear that binds
    return Leg(
        k_thigh=weight * geometry.l1 * float(rng.uniform(1.8, 2.2)),
        k_shin=weight * geometry.l2 * float(rng.uniform(0.9, 1.1)),
        thigh_off=rng.uniform(-0.02, 0.02, 2),
        shin_off=rng.uniform(-0.015, 0.015, 2),
        stop=robot.limits.knee.theta[1] + float(rng.uniform(0.0, 0.2)),
        friction=friction * rng.uniform(0.05, 4.0 if stiff else 0.9, 4),
    )


def hung(rng: np.random.Generator, leg: Leg) -> tuple[Array, Array]:
    """Return (phi, theta) of the knee, and of the thigh in the world, where a leg comes to rest."""
    knee_hold, hip_hold = (rng.uniform(-1.0, 1.0, 4) * leg.friction).reshape(2, 2)
    shin = leg.shin_off + knee_hold / leg.k_shin
    thigh = leg.thigh_off + (hip_hold - knee_hold) / leg.k_thigh
    knee = shin - thigh
    if knee[1] > leg.stop:
        knee[1] = leg.stop
        moment = hip_hold[1] + leg.k_thigh * leg.thigh_off[1] + leg.k_shin * leg.shin_off[1]
        thigh[1] = (moment - leg.k_shin * leg.stop) / (leg.k_thigh + leg.k_shin)
    return knee, thigh


def hip_of(thigh: Array, up: Array) -> Pair:
    """Return the hip's (phi, theta) for a thigh's in the world, and up in torso axes."""
    phi, theta = thigh
    v = np.array(
        [math.sin(theta), -math.cos(theta) * math.sin(phi), math.cos(theta) * math.cos(phi)]
    )
    q_theta = math.asin(v[0] / math.hypot(up[0], up[2])) - math.atan2(up[0], up[2])
    z = up[2] * math.cos(q_theta) - up[0] * math.sin(q_theta)
    return math.atan2(up[1], z) - math.atan2(v[1], v[2]), q_theta


def tilted(rng: np.random.Generator, largest: float) -> Array:
    """Return up in the axes of a torso that tilts any way, rad."""
    x, y = rng.uniform(-largest, largest, 2) / math.sqrt(2.0)
    up = np.array([x, y, 1.0])
    return np.asarray(up / np.linalg.norm(up), float)


def power_cycle(rng: np.random.Generator, robot: RobotConfig, friction: float = 1.0) -> PowerCycle:
    """Draw one, with so many times the usual friction."""
    event = EVENTS[rng.integers(len(EVENTS))]
    legs = {side: drawn_leg(rng, robot, friction) for side in SIDES}
    levelled = rng.random() < 0.3
    up = tilted(rng, 0.03 if levelled else 0.3)
    q: dict[str, Pair] = {}
    for side in SIDES:
        _hang(rng, robot, side, legs[side], up, q)
    before = dict(q)
    rested = rng.random() < 0.8 and event != "power cut at work"
    swings: dict[str, tuple[Pair, Pair] | None] = dict.fromkeys(MODULES)
    by_hand = list(SIDES) if event in ("both legs by hand", "power cut at work") else []
    if event == "payload":
        up = tilted(rng, 0.03 if levelled else 0.3)
        by_hand = list(SIDES)
    some = SIDES[rng.integers(2)]
    if event in ("leg by hand", "leans", "jammed") or (
        event in ("encoder exchanged", "cables swapped") and rng.random() < 0.5
    ):
        by_hand = [some]
    for side in by_hand:
        keep = q[f"ankle_{side}"]
        _hang(rng, robot, side, legs[side], up, q)
        if event == "payload":
            q[f"ankle_{side}"] = keep
    rested |= event == "magnet slipped"  # nobody knows it: a joint that moved as well is fooled
    swung = rng.random() < 0.9
    for module in MODULES:
        if swung and not module.startswith("ankle"):
            swings[module] = _swing(rng, legs[side_of(module)], kind_of(module))
    if event == "leans":  # nothing swings through what it leans on
        lean = (rng.uniform(-0.3, 0.3), rng.uniform(-1.2, -0.05))
        q[f"knee_{some}"] = lean
        q[f"hip_{some}"] = (rng.uniform(-0.4, 0.4), rng.uniform(-0.6, 0.8))
        low, high = map(np.array, _swing(rng, legs[some], "hip"))
        axis, sign = rng.integers(2), rng.random() < 0.5
        (low if sign else high)[axis] = 0.0
        swings[f"hip_{some}"] = ((low[0], low[1]), (high[0], high[1]))
    if event == "jammed":  # a lattice's step off, or near it
        kind = ("knee", "hip")[rng.integers(2)]
        step = math.pi / robot.joint.gear_ratio
        phi, theta = q[f"{kind}_{some}"]
        off = rng.choice([-step, step], 2) + rng.uniform(-0.02, 0.02, 2)
        q[f"{kind}_{some}"] = (phi + off[0], theta + (-abs(off[1]) if kind == "knee" else off[1]))
        swings[f"{kind}_{some}"] = NO_SWING
    on_usb, his_word = rng.random() < 0.5, rng.random() < 0.8
    measured = rng.random() < 0.2
    counts, ratio = robot.joint.encoder_counts_per_turn, robot.joint.gear_ratio
    evidence = {}
    touched = MODULES[rng.integers(6)]
    for module in MODULES:
        stranger, untouched = "", his_word
        glued = rng.random(2)  # where the magnets sit
        offsets = _counted(glued, counts)
        turns = np.array(motor_from_joint(q[module], ratio))
        rest = np.array(motor_from_joint(before[module], ratio))
        angles = _counted((turns - glued) % 1.0, counts)
        axis = rng.integers(2)
        if module == touched and event in ("encoder exchanged", "magnet slipped"):
            angles[axis] = _counted(np.array([rng.random()]), counts)[0]
        if module == touched and event == "board exchanged" and rng.random() < 0.5:
            angles = angles[::-1]  # and its encoders on the other axes
        if module == touched and event == "cables swapped":
            angles = angles[::-1]
        if module == touched and event in REPAIRS:
            stranger = STRANGER if on_usb and event != "cables swapped" else ""
            untouched = False  # he knows what he has exchanged
        evidence[module] = ModuleEvidence(
            offsets=(offsets[0], offsets[1]),
            angles=(angles[0], angles[1]),
            rest=(rest[0], rest[1]) if rested else None,
            swing=swings[module],
            about=_roughly(rng, q[module]) if measured and module.startswith("ankle") else None,
            untouched=untouched,
            stranger=stranger,
        )
    kind = rng.random()
    if kind < 0.5:
        imu = up + rng.normal(0.0, 0.006, 3)
        known = Upright((imu[0], imu[1], imu[2]), 0.02)
    else:
        known = Upright((0.0, 0.0, 1.0), 0.035 if levelled else math.inf)
    return PowerCycle(event, evidence, known, q)


def _swing(rng: np.random.Generator, leg: Leg, kind: str) -> tuple[Pair, Pair]:
    """Return how far a joint swings that is pushed to one side and let go: friction stops it."""
    knee, hip = leg.friction.reshape(2, 2)
    stuck = knee / leg.k_shin + (knee + hip) / leg.k_thigh
    if kind == "hip":
        stuck = (knee + hip) / (leg.k_thigh + leg.k_shin)
    pushed = rng.uniform(0.1, 0.4, 2)
    back = np.maximum(0.0, pushed - 2.0 * stuck)
    return (-float(back[0]), -float(back[1])), (float(pushed[0]), float(pushed[1]))


def _hang(
    rng: np.random.Generator,
    robot: RobotConfig,
    side: str,
    leg: Leg,
    up: Array,
    q: dict[str, Pair],
) -> None:
    """Let a leg come to rest, its ankle anywhere."""
    knee, thigh = hung(rng, leg)
    q[f"knee_{side}"] = (float(knee[0]), float(knee[1]))
    q[f"hip_{side}"] = hip_of(thigh, up)
    limit = getattr(robot.limits, kind_of(f"ankle_{side}"))
    phi, theta = (rng.uniform(low - 0.1, high + 0.1) for low, high in (limit.phi, limit.theta))
    q[f"ankle_{side}"] = (phi, theta)


def _roughly(rng: np.random.Generator, q: Pair) -> Pair:
    """Return angles as somebody measures them who takes no pains."""
    off, way = float(rng.uniform(0.0, 0.9 * MEASURED)), float(rng.uniform(0.0, math.tau))
    return q[0] + off * math.cos(way), q[1] + off * math.sin(way)


def _counted(turns: Array, counts: int) -> Array:
    """Return turns as whole counts."""
    return np.asarray(np.floor(turns * counts) % counts / counts, float)
