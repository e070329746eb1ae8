"""Recover the whole turns that the motors made since the joints were zeroed. Pure.

After a loss of power, an absolute encoder reports its angle within the motor's turn, but not the
number of turns. With the angles stored at the joint's zero, the possible poses form a lattice: one
turn of one motor is pi / N, 0.18 rad, in both phi and theta, so the nearest other pose is 0.25 rad
away. Four kinds of evidence select the pose:

- Gravity. A leg that hangs free has its centre of mass below its hip at any tilt of the torso, so
  its knee hangs straight or on its stop. The hip's pose then implies the direction of up, which can
  be compared with an IMU or a spirit level. A leg that leans on something looks like a hanging leg
  that is some turns off, so the leg must swing through its rest position.
- The last rest. If both encoders of a joint read the same as at its last rest, the joint has not
  moved, and neither encoder was exchanged or slipped. If the joint has moved, a person must confirm
  that its encoders were not touched.
- A rough measurement by a person. An ankle that has moved needs one, because its mass lies on its
  axis, so gravity says nothing about it.
- The limits of the joints.

A pose is accepted if friction and model errors explain its deviation, and the second-best pose
deviates by at least `CLEAR` times what they explain. Otherwise the joint is refused, because with a
wrong number of turns the robot would fall, and measuring with a protractor takes only a minute.
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
"""Minimum error of the second-best pose, as a multiple of the explained error."""
READS_ZERO: Final = 1e-4
"""Distance from 0 within which an encoder may be stuck at 0, turns: 1.6 counts of 16384."""
UNMOVED: Final = 0.0015
"""Maximum change of both encoders' angles if a joint has not moved, turns: 0.5 mrad at the joint,
more than temperature changes an encoder's error. A moved joint is this close by chance once in
110 000 times."""
BESIDE_MOVED: Final = 0.2
"""Fraction of `UNMOVED` that is allowed if another joint of the leg has moved. A moved joint is
this close by chance once in 3 million times."""
STAYED: Final = 2.0
"""Multiple of `UNMOVED` above which a motor has certainly moved."""
MEASURED: Final = 0.08
"""Maximum error of a rough measurement, rad."""
LEGS_APART: Final = 0.1
"""Maximum angle between the up directions found from the two legs, rad."""

UNTOUCHED: Final = "no encoder, magnet, motor or encoder cable has been touched since zeroing"
SWING: Final = "let it swing (--swing)"
PROTRACTOR: Final = "zero it with a protractor (--at), as on the first day"
ROUGHLY: Final = (
    f"measure it to {MEASURED:g} rad ({math.degrees(MEASURED):.1f} degrees) and add --at PHI,THETA"
)


class ModuleEvidence(NamedTuple):
    """Evidence for the turns of a module's motors, which are counted from the joint's zero."""

    offsets: Pair
    """Motor turns, modulo 1, at which each encoder reads 0."""
    angles: Pair
    """Present encoder angles within the turn, turns."""
    rest: Pair | None = None
    """Motor turns at the last rest of the powered and zeroed joint, or None."""
    about: Pair | None = None
    """Rough (phi, theta) measured by a person, rad."""
    swing: tuple[Pair, Pair] | None = None
    """Lowest and highest (phi, theta) of a swing, relative to the present rest position, rad."""
    untouched: bool = False
    """True if a person confirms that no part was touched since the zeroing (`UNTOUCHED`)."""
    stranger: str = ""
    """Reason why board or encoders differ from those at the zero, or ""."""


class Decision(NamedTuple):
    """Decision on the pose of a module."""

    q: Pair | None
    """(phi, theta), rad; None if refused."""
    by: str
    """Evidence that decided: "gravity", "unmoved" or "measured"; "" if refused."""
    second: float
    """Distance to the second-best pose, rad; inf if there is none."""
    times: float
    """Error of the second-best pose, as a multiple of the allowed error."""
    why: str
    """Reason for a refusal, and remedy, or ""."""


class _Candidates(NamedTuple):
    """Poses of a module that its encoders allow, and the decision by its own evidence."""

    poses: Array
    """(n, 2): phi, theta, rad."""
    own: Decision | None
    """Decision by all evidence except gravity; None if gravity must decide."""

    @property
    def unmoved(self) -> bool:
        """True if its pose is that of its last rest; gravity must not contradict this pose."""
        return self.own is not None and self.own.by == "unmoved"

    @property
    def q(self) -> Array:
        """Remaining poses: one if its own evidence decides, none if it refuses."""
        if self.own is None:
            return self.poses
        return np.empty((0, 2)) if self.own.q is None else np.array([self.own.q])


def poses_of(evidence: ModuleEvidence, robot: RobotConfig, module: str) -> Array:
    """Return every pose (n, 2), rad, that a module's encoder angles and limits allow."""
    limit = getattr(robot.limits, kind_of(module))
    (phi_low, phi_high), (theta_low, theta_high) = limit.phi, limit.theta
    half = math.pi / robot.joint.gear_ratio
    first = [a + b for a, b in zip(evidence.offsets, evidence.angles, strict=True)]
    low, high = theta_low - 2.0 * BEYOND, theta_high + 2.0 * BEYOND
    # ranges of the motors' angles, theta + phi and theta - phi
    spans = ((low + phi_low, high + phi_high), (low - phi_high, high - phi_low))
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
    """Return the pose of each module, or the reason for its refusal.

    Hips and knees must hang. Gravity can decide only if both knee and hip of a leg have evidence.
    """
    found: dict[str, Decision] = {}
    ups: dict[str, Array] = {}
    candidates = {name: _candidates(robot, evidence, name) for name in evidence}
    for side in SIDES:
        ankle, knee, hip = (f"{kind}_{side}" for kind in ("ankle", "knee", "hip"))
        if ankle in evidence:
            found[ankle] = candidates[ankle].own or _refused(
                f"{_since(evidence[ankle])}, and gravity says nothing about an ankle (possible "
                f"poses: {len(candidates[ankle].poses)}); {ROUGHLY}"
            )
        if knee in evidence and hip in evidence:
            leg = _leg(robot, evidence, candidates, side, upright)
            found |= leg
            q_knee, q_hip = leg[knee].q, leg[hip].q
            if q_knee and q_hip and "measured" not in (leg[knee].by, leg[hip].by):
                ups[side] = implied_up(robot, np.array([q_knee]), np.array([q_hip]))[0, 0]
        else:
            alone = "gravity decides knee and hip together; both need a zero and a readable drive"
            for name in {knee, hip} & set(evidence):
                own = candidates[name].own
                is_taken = own is not None and not candidates[name].unmoved
                found[name] = own if own and is_taken else _refused(alone)
    if len(ups) == len(SIDES):
        apart = float(angle(ups["right"], ups["left"]))
        if apart > LEGS_APART:
            why = (
                f"the up directions found from the two legs differ by {apart:.2f} rad: one leg "
                "leans on something or binds; let both hang free, and try again"
            )
            legs = [f"{kind}_{side}" for side in SIDES for kind in ("knee", "hip")]
            found |= {name: _refused(why) for name in legs}
    return {module: found[module] for module in evidence}


def _candidates(
    robot: RobotConfig, evidence: Mapping[str, ModuleEvidence], module: str
) -> _Candidates:
    """Return a module's poses, and the decision by all evidence except gravity."""
    one, poses = evidence[module], poses_of(evidence[module], robot, module)
    leg = [evidence.get(f"{kind}_{side_of(module)}") for kind in KINDS]
    rests = all(other is not None and _moved(other, UNMOVED) is None for other in leg)
    within = UNMOVED if rests else BESIDE_MOVED * UNMOVED
    return _Candidates(poses, _own(one, poses, robot.joint.gear_ratio, within))


def _own(
    evidence: ModuleEvidence, poses: Array, gear_ratio: float, unmoved: float
) -> Decision | None:
    """Decide by a module's own evidence; None if gravity must. `unmoved` is a tolerance, turns."""
    if not len(poses):
        return _refused(f"its angles fit no pose inside its limits; {PROTRACTOR}")
    if any(min(angle, 1.0 - angle) < READS_ZERO for angle in evidence.angles):
        return _refused(
            "an encoder reads exactly 0, as without power or with a broken wire; move the joint a "
            "little, and try again"
        )
    if evidence.stranger:
        return _refused(f"{evidence.stranger}; {PROTRACTOR}")
    moved = _moved(evidence, unmoved)
    if moved:
        return _refused(f"{moved}; {PROTRACTOR}")
    if moved is None and evidence.rest is not None and evidence.about is None:
        return _rested(evidence.rest, poses, gear_ratio, unmoved)
    if moved is not None and not evidence.untouched:
        return _refused(f"{_since(evidence)}: if {UNTOUCHED}, add --untouched; else {PROTRACTOR}")
    return None if evidence.about is None else _measured(evidence.about, poses)


def _leg(
    robot: RobotConfig,
    evidence: Mapping[str, ModuleEvidence],
    candidates: Mapping[str, _Candidates],
    side: str,
    upright: Upright,
) -> dict[str, Decision]:
    """Decide knee and hip of a leg, which gravity couples.

    A knee that is one turn off moves the leg's centre of mass by 0.17 rad about the hip. Turns of
    the hip can compensate for only a part of this: 0.09 rad remain.
    """
    names = knee, hip = f"knee_{side}", f"hip_{side}"
    own = {name: candidates[name].own for name in names}
    if all(one is not None and one.by == "measured" for one in own.values()):
        return {name: one for name, one in own.items() if one is not None}
    for name in names:
        refused = own[name]
        if refused is not None and refused.q is None:
            why = f"gravity decides it only together with {name}, which is refused; {ROUGHLY}"
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
            "its leg has not moved since its last rest, but does not hang: its error is "
            f"{score:.1f} times what friction and the robot file's errors explain; {ROUGHLY}"
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
            f"{_words(q_hip[best[1]])}, has {score:.1f} times the error that friction and the "
            f"robot file's errors explain; let it swing and try again, or {ROUGHLY}"
        )
    if not why and times < CLEAR:
        why = (
            f"a second pose of its leg, knee {_words(q_knee[second[0]])} and hip "
            f"{_words(q_hip[second[1]])}, has only {times:.1f} times the error that friction and "
            f"the robot file's errors explain; at least {CLEAR:g} times is required; {ROUGHLY}"
        )
    steps = [q[one] - q[o] for q, one, o in zip((q_knee, q_hip), best, second, strict=True)]
    away = float(np.linalg.norm(steps))
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
    """Return why gravity cannot decide a leg's turns yet, and the remedy, or ""."""
    if not upright.is_known:
        return (
            "the direction of up is unknown: fit an IMU, or level the torso with a spirit level "
            f"and add --level; or {ROUGHLY}"
        )
    for kind in ("hip", "knee"):
        swing = evidence[f"{kind}_{side}"].swing
        if swing is None:
            return f"it is unknown whether its leg hangs free or leans on something: {SWING}"
        missing = not_swung(swing, knee=kind == "knee")
        if missing:
            return (
                f"its leg's {kind} has not swung past its rest position in {missing}: it leans on "
                f"something or binds, or was pushed too little; {SWING} again"
            )
    return ""


def _measured(about: Pair, poses: Array) -> Decision:
    """Decide by a rough measurement `about`, rad."""
    off = np.linalg.norm(poses - np.array(about), axis=1)
    best = int(np.argmin(off))
    if off[best] > MEASURED:
        return _refused(
            f"the nearest pose that its encoders allow, {_words(poses[best])} rad, is "
            f"{off[best]:.2f} rad from the measurement, and at most {MEASURED:g} is allowed: "
            f"measure again; if this persists, the stored zero is wrong: {PROTRACTOR}"
        )
    phi, theta = map(float, poses[best])
    if len(poses) == 1:
        return Decision((phi, theta), "measured", math.inf, math.inf, "")
    second = int(np.argsort(off)[1])
    away = float(np.linalg.norm(poses[second] - poses[best]))
    return Decision((phi, theta), "measured", away, float(off[second]) / MEASURED, "")


def _moved(evidence: ModuleEvidence, unmoved: float) -> str | None:
    """Return None if a joint is within `unmoved` turns of its rest, else a fault or "".

    The result is "" if the joint has moved, or its rest is unknown. A joint that moves turns both
    motors. If only one encoder's angle changed, this encoder was exchanged or slipped. If the
    encoders read each other's angles, their cables are swapped.
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
            f"axis{axis}'s encoder is off by {apart[axis]:.3f} turns, but axis{1 - axis}'s has not "
            f"moved: axis{axis}'s was exchanged or has slipped"
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
            f"it has not moved since its last rest, which is outside its limits; {PROTRACTOR}"
        )
    phi, theta = map(float, poses[best])
    others = np.delete(poses, best, axis=0)
    second = np.min(np.linalg.norm(others - poses[best], axis=1)) if len(others) else math.inf
    return Decision((phi, theta), "unmoved", float(second), 1.0 / unmoved, "")


def _since(evidence: ModuleEvidence) -> str:
    """Return why the last rest of a module does not decide."""
    return "it has moved since its last rest" if evidence.rest else "its last rest is not stored"


def _refused(why: str) -> Decision:
    return Decision(None, "", math.inf, math.inf, why)


def _words(q: Array) -> str:
    return f"{q[0]:+.2f} {q[1]:+.2f}"


def _wrapped(turns: float) -> float:
    return turns - round(turns)
