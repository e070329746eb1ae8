"""Finds again how many whole turns the motors have made since the joints' zeros. Pure.

After a loss of power an absolute encoder tells its angle within the motor's turn and no turns. The
angles that were stored with a joint's zero leave a lattice of poses: one turn of one motor is
pi / N, 0.18 rad, in phi and in theta at once, so the nearest other pose is 0.25 rad away. Four
things tell which pose it is:

- Gravity. A leg that hangs free has its centre of mass below its hip, however the torso tilts: so
  its knee hangs straight or on its stop. The hip then tells which way is up, and an IMU or a spirit
  level does so too. A leg that leans on something looks like one that hangs, some turns off: so the
  leg has to swing through where it rests.
- A joint whose encoders both read what they read when it last rested has not moved. This alone
  shows that they are the same encoders: one that was exchanged or has slipped reads something
  else. For a joint that has moved a person has to say so.
- A rough measurement by a person.
- The limits of the joints. Gravity does not hold an ankle: its mass lies in its axis.

A pose is taken if friction and errors of the model explain it, and the second best takes at least
`CLEAR` times as much. Everything else is refused: a wrong turn makes the robot fall, a protractor
takes a minute.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from services.joint.differential import joint_from_motor
from shared.arrays import Array
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.joints import KINDS, SIDES, kind_of, side_of
from tools.bringup.hanging_leg import BEYOND, Upright, angle, implied_up, leg_scores, not_swung

CLEAR: Final = 1.5
"""Times what is explained that the second best pose must take."""
READS_ZERO: Final = 1e-4
"""turns: nearer to 0 than two counts of 16384, an encoder may read nothing but 0."""
UNMOVED: Final = 0.0015
"""turns; encoders that both read the same so closely have not moved: 0.3 mrad at the joint, more
than an encoder's error changes with its temperature. A joint that was moved reads so by chance once
in 110 000 times."""
BESIDE_MOVED: Final = 0.2
"""Fraction of `UNMOVED` for a joint of whose leg another one has moved: once in 3 million times."""
STAYED: Final = 2.0
"""Times `UNMOVED` from which a motor has moved for sure."""
MEASURED: Final = 0.08
"""rad by which a rough measurement may be off."""
LEGS_APART: Final = 0.1
"""rad by which the two legs may differ in which way is up."""

UNTOUCHED: Final = "no encoder, magnet, motor or encoder cable was touched since its zero"
SWING: Final = "let it swing (--swing)"
PROTRACTOR: Final = "zero it by a protractor (--at), as on the first day"
ROUGHLY: Final = (
    f"measure it to {MEASURED:g} rad ({math.degrees(MEASURED):.1f} degrees) and add --at PHI,THETA"
)


class ModuleEvidence(NamedTuple):
    """What is known of a module without its turns; motor turns are from the joint's zero."""

    offsets: Pair
    """Motor turns, but for whole ones, at which each encoder reads 0."""
    angles: Pair
    """Where the encoders are within the turn now, turns."""
    rest: Pair | None = None
    """Motor turns where the joint last rested, powered and zeroed; None: unknown."""
    about: Pair | None = None
    """(phi, theta) as somebody has measured them, rad."""
    swing: tuple[Pair, Pair] | None = None
    """Lowest and highest (phi, theta) seen since a first look, from where it rests now, rad."""
    untouched: bool = False
    """Somebody says that its encoders, magnets, motors and cables are those of the zero."""
    stranger: str = ""
    """Why board or encoders are not those of the zero; "" if nothing speaks against it."""


class Decision(NamedTuple):
    """What came of a module."""

    q: Pair | None
    """(phi, theta), rad; None: refused."""
    by: str
    """What decided it: "gravity", "unmoved" or "measured"; "" where refused."""
    second: float
    """rad from it to the second best pose; inf if there is none."""
    times: float
    """How many times what is allowed the second best takes."""
    why: str
    """Why it was refused, and what to do; "" if it was not."""


class _Candidates(NamedTuple):
    """Poses of a module that its angles allow, and what its own evidence says of them."""

    poses: Array
    """(n, 2): phi, theta, rad."""
    own: Decision | None
    """What its own evidence decides: a pose, or to refuse; None: gravity is left."""
    unmoved: bool
    """Its pose is that of its rest, which is not to speak against gravity."""

    @property
    def q(self) -> Array:
        """The poses that are left, (1, 2) if its own evidence has decided, (0, 2) if it refuses."""
        if self.own is None:
            return self.poses
        return np.empty((0, 2)) if self.own.q is None else np.array([self.own.q])


def poses_of(evidence: ModuleEvidence, robot: RobotConfig, module: str) -> Array:
    """Return every pose (n, 2), rad, that a module's angles and limits allow."""
    limit = getattr(robot.limits, kind_of(module))
    (phi_low, phi_high), (theta_low, theta_high) = limit.phi, limit.theta
    half = math.pi / robot.joint.gear_ratio
    first = [a + b for a, b in zip(evidence.offsets, evidence.angles, strict=True)]
    spans = [
        (theta_low - BEYOND + sign * phi, theta_high + BEYOND + sign * other)
        for sign, phi, other in (
            (1.0, phi_low - BEYOND, phi_high + BEYOND),
            (-1.0, phi_high + BEYOND, phi_low - BEYOND),
        )
    ]  # of theta + phi and theta - phi, which are the motors'
    turns = [
        start + np.arange(math.ceil(low / (2.0 * half) - start), high / (2.0 * half) - start + 1e-9)
        for start, (low, high) in zip(first, spans, strict=True)
    ]
    m1, m2 = (each.ravel() for each in np.meshgrid(*turns, indexing="ij"))
    phi, theta = joint_from_motor((m1, m2), robot.joint.gear_ratio)  # type: ignore[arg-type]
    q = np.column_stack([phi, theta])
    inside = (phi >= phi_low - BEYOND) & (phi <= phi_high + BEYOND)
    inside &= (theta >= theta_low - BEYOND) & (theta <= theta_high + BEYOND)
    return np.asarray(q[inside], float)


def decide(
    robot: RobotConfig, evidence: Mapping[str, ModuleEvidence], upright: Upright
) -> dict[str, Decision]:
    """Return the pose of each module, or why none is taken.

    Hips and knees hang; where one is to be found by gravity, both of its leg are evidence.
    """
    found: dict[str, Decision] = {}
    ups: dict[str, Array] = {}
    candidates = {name: _candidates(robot, evidence, name) for name in evidence}
    for side in SIDES:
        ankle, knee, hip = (f"{kind}_{side}" for kind in ("ankle", "knee", "hip"))
        if ankle in evidence:
            found[ankle] = candidates[ankle].own or _refused(
                f"{_since(evidence[ankle])}, and gravity does not hold an ankle: "
                f"{len(candidates[ankle].poses)} poses are possible; {ROUGHLY}"
            )
        if knee in evidence and hip in evidence:
            leg = _leg(robot, evidence, candidates, side, upright)
            found |= leg
            q_knee, q_hip = leg[knee].q, leg[hip].q
            if q_knee and q_hip and "measured" not in (leg[knee].by, leg[hip].by):
                ups[side] = implied_up(robot, np.array([q_knee]), np.array([q_hip]))[0, 0]
        else:
            alone = "gravity tells a knee and its hip together: look at both"
            for name in {knee, hip} & set(evidence):
                own = candidates[name].own
                is_taken = own is not None and not candidates[name].unmoved
                found[name] = own if own and is_taken else _refused(alone)
    if len(ups) == len(SIDES):
        apart = float(angle(ups["right"], ups["left"]))
        if apart > LEGS_APART:
            why = (
                f"the legs differ by {apart:.2f} rad in which way is up: one leans on something, "
                "or binds; let both hang free, and again"
            )
            legs = [f"{kind}_{side}" for side in SIDES for kind in ("knee", "hip")]
            found |= {name: _refused(why) for name in legs}
    return {module: found[module] for module in evidence}


def _candidates(
    robot: RobotConfig, evidence: Mapping[str, ModuleEvidence], module: str
) -> _Candidates:
    """Return a module's poses, and what all evidence but gravity says of them."""
    one, poses = evidence[module], poses_of(evidence[module], robot, module)
    leg = [evidence.get(f"{kind}_{side_of(module)}") for kind in KINDS]
    rests = all(other is not None and _moved(other, UNMOVED) is None for other in leg)
    within = UNMOVED if rests else BESIDE_MOVED * UNMOVED
    own = _own(one, poses, robot.joint.gear_ratio, within)
    return _Candidates(poses, own, own is not None and own.by == "unmoved")


def _own(
    evidence: ModuleEvidence, poses: Array, gear_ratio: float, unmoved: float
) -> Decision | None:
    """Decide a module by itself; None: gravity may. Encoders so near to their rest are unmoved."""
    if not len(poses):
        return _refused(f"its angles fit no pose inside its limits; {PROTRACTOR}")
    if any(min(angle, 1.0 - angle) < READS_ZERO for angle in evidence.angles):
        return _refused(
            "an encoder reads exactly 0, as one without power or with a broken line does; "
            "move the joint a little, and again"
        )
    if evidence.stranger:
        return _refused(f"{evidence.stranger}; {PROTRACTOR}")
    moved = _moved(evidence, unmoved)
    if moved:
        return _refused(f"{moved}; {PROTRACTOR}")
    if moved is None and evidence.rest is not None and evidence.about is None:
        return _rested(evidence.rest, poses, gear_ratio, unmoved)
    if moved is not None and not evidence.untouched:
        return _refused(
            f"{_since(evidence)}: if {UNTOUCHED}, say so (--untouched); else {PROTRACTOR}"
        )
    return None if evidence.about is None else _measured(evidence.about, poses)


def _leg(
    robot: RobotConfig,
    evidence: Mapping[str, ModuleEvidence],
    candidates: Mapping[str, _Candidates],
    side: str,
    upright: Upright,
) -> dict[str, Decision]:
    """Decide knee and hip of a leg, which gravity ties together.

    A knee a turn off moves the leg's centre of mass by 0.17 rad about the hip, which no turn of the
    hip makes good: 0.09 rad are left.
    """
    names = knee, hip = f"knee_{side}", f"hip_{side}"
    own = {name: candidates[name].own for name in names}
    if all(one is not None and one.by == "measured" for one in own.values()):
        return {name: one for name, one in own.items() if one is not None}
    for name in names:
        refused = own[name]
        if refused is not None and refused.q is None:
            why = f"gravity tells it together with {name}, which is refused; {ROUGHLY}"
            others = {n: o if o and o.by == "measured" else _refused(why) for n, o in own.items()}
            return others | {n: o for n, o in own.items() if o is not None and o.q is None}
    q_knee, q_hip = candidates[knee].q, candidates[hip].q
    scores = leg_scores(robot, q_knee, q_hip, upright)
    best = divmod(int(np.argmin(scores)), len(q_hip))
    score = float(scores[best])
    if all(own.values()):
        if score <= CLEAR:
            return {name: one for name, one in own.items() if one is not None}
        why = (
            f"its leg has not moved since it last rested, and does not hang: it takes {score:.1f} "
            f"times what friction and errors of the robot file explain; {ROUGHLY}"
        )
        return {
            name: one if one is not None and one.by == "measured" else _refused(why)
            for name, one in own.items()
        }
    why = _why_not_by_gravity(evidence, side, upright)
    worse = scores.copy()
    worse[best] = math.inf
    second = divmod(int(np.argmin(worse)), len(q_hip))
    times = float(worse[second])
    if not why and score > 1.0:
        why = (
            f"its leg does not hang free: the best pose, knee {_words(q_knee[best[0]])} and hip "
            f"{_words(q_hip[best[1]])}, takes {score:.1f} times what friction and errors of the "
            f"robot file explain; let it swing, and again; or {ROUGHLY}"
        )
    if not why and times < CLEAR:
        why = (
            f"a second pose of its leg, knee {_words(q_knee[second[0]])} and hip "
            f"{_words(q_hip[second[1]])}, takes only {times:.1f} times what friction and errors "
            f"of the robot file explain, {CLEAR:g} are wanted; {ROUGHLY}"
        )
    knee_away, hip_away = (
        float(np.linalg.norm(q[one] - q[other]))
        for q, one, other in zip((q_knee, q_hip), best, second, strict=True)
    )
    away = math.hypot(knee_away, hip_away)
    result: dict[str, Decision] = {}
    for name, q, index in zip(names, (q_knee, q_hip), best, strict=True):
        mine = own[name]
        if mine is None and not why:
            taken = float(q[index, 0]), float(q[index, 1])
            result[name] = Decision(taken, "gravity", away, times, "")
        elif mine is None:
            result[name] = _refused(f"{_since(evidence[name])}, and {why}")
        else:
            result[name] = _refused(why) if why and candidates[name].unmoved else mine
    return result


def _why_not_by_gravity(evidence: Mapping[str, ModuleEvidence], side: str, upright: Upright) -> str:
    """Return what is missing to find a leg's turns by gravity; "" if nothing is."""
    if not upright.is_known:
        return (
            "nothing tells which way is up: fit an IMU, or level the torso by a spirit level and "
            f"add --level; or {ROUGHLY}"
        )
    for kind in ("hip", "knee"):
        swing = evidence[f"{kind}_{side}"].swing
        if swing is None:
            return f"whether its leg hangs free or leans on something is not known: {SWING}"
        missing = not_swung(swing, knee=kind == "knee")
        if missing:
            return (
                f"its leg's {kind} has not swung past where it rests in {missing}: it leans on "
                f"something or binds, or was pushed too little; {SWING} again"
            )
    return ""


def _measured(about: Pair, poses: Array) -> Decision:
    """Decide by a rough measurement, rad."""
    off = np.linalg.norm(poses - np.array(about), axis=1)
    best = int(np.argmin(off))
    if off[best] > MEASURED:
        return _refused(
            f"the nearest pose that its encoders allow, {_words(poses[best])} rad, is "
            f"{off[best]:.2f} rad from what was measured, {MEASURED:g} are allowed: measure again; "
            f"if it stays so, its zero is another's: {PROTRACTOR}"
        )
    others = np.delete(off, best)
    phi, theta = map(float, poses[best])
    second = int(np.argmin(others)) if len(others) else None
    if second is None:
        return Decision((phi, theta), "measured", math.inf, math.inf, "")
    away = float(np.linalg.norm(np.delete(poses, best, axis=0)[second] - poses[best]))
    return Decision((phi, theta), "measured", away, float(others[second]) / MEASURED, "")


def _moved(evidence: ModuleEvidence, unmoved: float) -> str | None:
    """Return None for a joint within so many turns of its rest, else what is wrong with it.

    A joint that moves turns both motors. One encoder that stayed beside one that did not, or two
    that read each other's angles, were exchanged.
    """
    if evidence.rest is None:
        return ""
    rested = [turns - offset for turns, offset in zip(evidence.rest, evidence.offsets, strict=True)]
    apart = [abs(_wrapped(a - b)) for a, b in zip(evidence.angles, rested, strict=True)]
    if max(apart) <= unmoved:
        return None
    if min(apart) <= UNMOVED and max(apart) > STAYED * UNMOVED:
        axis = apart.index(max(apart))
        return (
            f"axis{axis}'s encoder reads {apart[axis]:.3f} turns off and axis{1 - axis}'s has not "
            f"moved: axis{axis}'s was exchanged, or has slipped"
        )
    if min(apart) <= STAYED * UNMOVED:
        return ""
    crossed = [abs(_wrapped(a - b)) for a, b in zip(evidence.angles, rested[::-1], strict=True)]
    if max(crossed) <= UNMOVED:
        return "its two encoders read each other's angles: their cables are swapped"
    return ""


def _rested(rest: Pair, poses: Array, gear_ratio: float, unmoved: float) -> Decision:
    """Decide for a joint that has not moved."""
    away = np.linalg.norm(poses - np.array(joint_from_motor(rest, gear_ratio)), axis=1)
    best = int(np.argmin(away))
    if away[best] > UNMOVED:
        return _refused(
            f"it has not moved since it last rested, outside of its limits; {PROTRACTOR}"
        )
    phi, theta = map(float, poses[best])
    others = np.delete(poses, best, axis=0)
    second = np.min(np.linalg.norm(others - poses[best], axis=1)) if len(others) else math.inf
    return Decision((phi, theta), "unmoved", float(second), 1.0 / unmoved, "")


def _since(evidence: ModuleEvidence) -> str:
    """Return why its rest does not tell."""
    return "it has moved since it last rested" if evidence.rest else "no rest of it is stored"


def _refused(why: str) -> Decision:
    return Decision(None, "", math.inf, math.inf, why)


def _words(q: Array) -> str:
    return f"{q[0]:+.2f} {q[1]:+.2f}"


def _wrapped(turns: float) -> float:
    return turns - round(turns)
