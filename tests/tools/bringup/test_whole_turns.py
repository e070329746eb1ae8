"""Whole turns found again after a loss of power: none wrong, whatever was drawn."""

from __future__ import annotations

import math
import re
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.joint.differential import joint_from_motor, motor_from_joint
from services.planner.law.model import HangingLegs
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.joints import MODULE_INDEX, MODULES, N_JOINTS
from tests.tools.bringup.power_cycles import EVENTS, power_cycle
from tools.bringup.hanging_leg import BEYOND, Upright, implied_up, leg_scores
from tools.bringup.whole_turns import MEASURED, UNMOVED, Decision, ModuleEvidence, decide, poses_of

N = 17.5
STEP = math.pi / N
EXACT = 1e-3
"""rad"""
LEVEL = Upright((0.0, 0.0, 1.0), 0.02)
NOTHING = Upright((0.0, 0.0, 1.0), math.inf)
GLUED = (0.3, 0.8)
SWUNG = ((-0.1, -0.1), (0.1, 0.1))
HANGS: dict[str, Pair] = {"ankle": (0.1, 0.2), "knee": (0.01, -0.06), "hip": (-0.01, 0.03)}


def seen_at(q: Pair, **more: object) -> ModuleEvidence:
    """Return the evidence of a module whose pose is q, untouched; it swung."""
    angles = [
        (turns - glued) % 1.0 for turns, glued in zip(motor_from_joint(q, N), GLUED, strict=True)
    ]
    known: dict[str, object] = {"untouched": True, "swing": SWUNG, **more}
    return ModuleEvidence(GLUED, (angles[0], angles[1]), **known)  # type: ignore[arg-type]


def leg_at(**more: object) -> dict[str, ModuleEvidence]:
    """Return the evidence of a right leg that hangs; `knee=(phi, theta)` for another pose."""
    at = {kind: more.pop(kind, q) for kind, q in HANGS.items()}
    return {f"{kind}_right": seen_at(q, **more) for kind, q in at.items()}  # type: ignore[arg-type]


def rested(q: Pair) -> Pair:
    return motor_from_joint(q, N)


def is_wrong(decision: Decision, truth: Pair) -> bool:
    q = decision.q
    return q is not None and max(abs(a - b) for a, b in zip(q, truth, strict=True)) > EXACT


def judged(robot: RobotConfig, seed: int, cases: range, friction: float = 1.0) -> Counter[str]:
    """Return how many modules of drawn power cycles were resumed, refused and resumed wrongly."""
    count: Counter[str] = Counter()
    for case in cases:
        cycle = power_cycle(np.random.default_rng([seed, case]), robot, friction)
        for module, decision in decide(robot, cycle.evidence, cycle.upright).items():
            wrong = is_wrong(decision, cycle.truth[module])
            count["WRONG" if wrong else decision.by or "refused"] += 1
            assert not wrong, f"case {case}, {cycle.event}, {module}: {decision}"
            assert bool(decision.why) == (decision.q is None)
            if cycle.event == "nothing" and cycle.evidence[module].rest and not decision.q:
                count["refused at rest"] += 1
    return count


def test_no_power_cycle_of_some_hundreds_is_resumed_wrongly(robot: RobotConfig) -> None:
    """Legs with four times the friction are refused."""
    count, stiff = (judged(robot, 1, range(400), friction) for friction in (1.0, 4.0))
    assert count.total() >= 400 * len(MODULES)
    assert min(count[by] for by in ("unmoved", "gravity", "measured", "refused")) > 40
    assert count["refused at rest"] < 0.05 * 400 * len(MODULES) / len(EVENTS)
    assert 0 < stiff["gravity"] < 0.5 * count["gravity"]


@pytest.mark.wide
@pytest.mark.parametrize("thousand", range(10))
def test_no_power_cycle_of_ten_thousand_is_resumed_wrongly(
    robot: RobotConfig, thousand: int
) -> None:
    judged(robot, 7, range(1000 * thousand, 1000 * (thousand + 1)))


def test_a_leg_is_told_by_gravity_to_the_last_count(robot: RobotConfig) -> None:
    for module, decision in decide(robot, leg_at(), LEVEL).items():
        if module != "ankle_right":
            assert decision.by == "gravity"
            assert decision.q == pytest.approx(HANGS[module.partition("_")[0]], abs=1e-9)
            assert decision.second >= math.sqrt(2.0) * STEP - 1e-9
            assert decision.times >= 1.5


@pytest.mark.parametrize(
    ("more", "upright", "words"),
    [
        ({"untouched": False}, LEVEL, "--untouched"),
        ({"stranger": "board 3A is another"}, LEVEL, "board 3A.*protractor"),
        ({}, NOTHING, "IMU.*--level"),
        ({"swing": None}, LEVEL, "unknown whether its leg.*--swing"),
        ({"swing": ((0.0, -0.1), (0.1, 0.1))}, LEVEL, "hip has not swung.*to its left"),
        ({"knee": (0.5 * STEP, -0.06 - 0.5 * STEP)}, LEVEL, "does not hang free|a second pose"),
        ({"hip": (0.5 * STEP, 0.5 * STEP)}, LEVEL, "does not hang free|a second pose"),
    ],
    ids=["its parts", "another board", "up", "swing", "leans", "half a turn", "hip"],
)
def test_what_is_not_clear_is_refused_with_what_to_do(
    robot: RobotConfig, more: dict[str, object], upright: Upright, words: str
) -> None:
    found = decide(robot, leg_at(**more), upright)
    for module in ("knee_right", "hip_right"):
        assert found[module].q is None
        assert not is_wrong(found[module], (0.0, 0.0))
    why = " ".join(found[module].why for module in ("knee_right", "hip_right"))
    assert re.search(words, why), why


def test_an_ankle_is_told_by_its_rest_or_a_rough_measurement_only(robot: RobotConfig) -> None:
    where = HANGS["ankle"]
    assert "says nothing about an ankle" in decide(robot, leg_at(), LEVEL)["ankle_right"].why
    leg = {f"{kind}_right": seen_at(q, rest=rested(q)) for kind, q in HANGS.items()}
    assert decide(robot, leg, NOTHING)["ankle_right"].by == "unmoved"
    one = {"ankle_right": seen_at(where, about=(where[0] + 0.05, where[1] - 0.05))}
    assert decide(robot, one, NOTHING)["ankle_right"].q == pytest.approx(where, abs=1e-9)
    one = {"ankle_right": seen_at(where, about=(where[0] + 1.1 * MEASURED, where[1]))}
    assert "measure again" in decide(robot, one, NOTHING)["ankle_right"].why


def test_one_encoder_that_moved_beside_one_that_did_not_was_exchanged(robot: RobotConfig) -> None:
    leg = leg_at()
    for kind, q in HANGS.items():
        evidence = seen_at(q, rest=rested(q))
        first, second = evidence.angles
        slipped = evidence._replace(angles=(first, (second + 3.0 * UNMOVED) % 1.0))
        leg |= {f"{kind}_right": slipped}
        assert "axis1's was exchanged" in decide(robot, leg, LEVEL)[f"{kind}_right"].why
        swapped = evidence._replace(angles=((rested(q)[1] - GLUED[1]) % 1.0, first))
        leg |= {f"{kind}_right": swapped}
        assert "cables are swapped" in decide(robot, leg, LEVEL)[f"{kind}_right"].why


def test_an_encoder_that_reads_nothing_but_0_is_refused(robot: RobotConfig) -> None:
    leg = leg_at()
    leg |= {"knee_right": leg["knee_right"]._replace(angles=(0.0, 0.4))}
    assert "reads exactly 0" in decide(robot, leg, LEVEL)["knee_right"].why


def test_a_rest_that_does_not_hang_is_no_evidence(robot: RobotConfig) -> None:
    """As after turns that were lost before it was stored."""
    q = HANGS["knee"]
    off = (q[0] + STEP, q[1] - STEP)
    leg = {f"{kind}_right": seen_at(q, rest=rested(q)) for kind, q in HANGS.items()}
    leg |= {"knee_right": seen_at(q, rest=rested(off))}
    found = decide(robot, leg, LEVEL)
    assert found["knee_right"].q is None
    assert "does not hang" in found["knee_right"].why


def test_legs_that_do_not_agree_which_way_is_up_are_refused(robot: RobotConfig) -> None:
    right = {f"{kind}_right": seen_at(q, rest=rested(q)) for kind, q in HANGS.items()}
    tilted = {**HANGS, "hip": (0.0, 0.16)}
    left = {f"{kind}_left": seen_at(q, rest=rested(q)) for kind, q in tilted.items()}
    found = decide(robot, {**right, **left}, NOTHING)
    assert "up directions found from the two legs differ" in found["knee_left"].why
    assert found["ankle_left"].by == "unmoved"


# ---- the lattice and the statics, against plain ones


@settings(max_examples=20)
@given(
    glued=st.tuples(st.floats(0.0, 0.999), st.floats(0.0, 0.999)),
    angles=st.tuples(st.floats(0.0, 0.999), st.floats(0.0, 0.999)),
    module=st.sampled_from(MODULES),
)
def test_the_poses_are_all_whole_turns_inside_the_limits(
    robot: RobotConfig, glued: Pair, angles: Pair, module: str
) -> None:
    limit = getattr(robot.limits, module.partition("_")[0])
    near = 1e-9
    expected = set()
    for first in range(-17, 27):
        for second in range(-17, 27):
            turns = (glued[0] + angles[0] + first, glued[1] + angles[1] + second)
            q = joint_from_motor(turns, N)
            spans = zip(q, (limit.phi, limit.theta), strict=True)
            if all(low - BEYOND - near <= x <= high + BEYOND + near for x, (low, high) in spans):
                expected.add((round(q[0], 6), round(q[1], 6)))
    found = poses_of(ModuleEvidence(glued, angles), robot, module)
    assert {(round(phi, 6), round(theta, 6)) for phi, theta in found.tolist()} == expected


@pytest.mark.parametrize("knee", [(0.0, -0.06), (0.2, -0.5), (-0.3, -1.2), (0.1, -1.4)])
def test_a_leg_s_balance_is_pinocchio_s(robot: RobotConfig, knee: Pair) -> None:
    """Where gravity leaves no torque at the hip of an upright torso, up is up."""
    legs, q = HangingLegs(robot), np.zeros(N_JOINTS)
    at = 2 * MODULE_INDEX["hip_right"]
    q[at - 2 : at] = knee
    for _ in range(50):
        torque = legs.torque(q)[at : at + 2]
        slopes = [
            (legs.torque(q + 1e-5 * np.eye(N_JOINTS)[at + i])[at : at + 2] - torque) / 1e-5
            for i in (0, 1)
        ]
        q[at : at + 2] -= np.linalg.solve(np.array(slopes).T, torque)
    assert np.abs(legs.torque(q)[at : at + 2]).max() < 1e-9
    up = implied_up(robot, np.array([knee]), q[None, at : at + 2])[0, 0]
    assert up == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    torque = -legs.torque(q)[at - 2 : at]
    pulls = np.abs([torque[0], min(torque[1], 0.0) if knee[1] > -0.25 else torque[1]])
    l1, l2 = robot.geometry.l1, robot.geometry.l2
    weight = robot.mass.module * 9.81
    allowed = 0.03 * weight * l2 * 2.0 * l1 / (2.0 * l1 + l2) + 1.0 + l2 / (2.0 * l1 + l2)
    score = leg_scores(robot, np.array([knee]), q[None, at : at + 2], LEVEL)[0, 0]
    assert score == pytest.approx(pulls.max() / allowed, rel=1e-6)


@pytest.mark.parametrize("case", range(12))
def test_brute_force_over_all_turns_with_pinocchio_finds_the_same(
    robot: RobotConfig, case: int
) -> None:
    """Of every pair of poses of a leg, the one that takes the least torque."""
    legs, rng = HangingLegs(robot), np.random.default_rng(case)
    knee = (float(rng.uniform(-0.03, 0.03)), float(rng.uniform(-0.1, -0.02)))
    lean = 1.03 / (1.03 + 2.0 * 0.267)  # of the centre of mass, by a knee's angle
    hip = (float(rng.uniform(-0.02, 0.02)) - lean * knee[0], -lean * knee[1])
    leg = leg_at(knee=knee, hip=hip)
    found = decide(robot, leg, LEVEL)
    q, at = np.zeros(N_JOINTS), 2 * MODULE_INDEX["hip_right"]
    best = (math.inf, knee, hip)
    turns = range(-4, 5)
    for a, b, c, d in np.array(np.meshgrid(turns, turns, turns, turns)).reshape(4, -1).T:
        one = (knee[0] + (a - b) * STEP, knee[1] + (a + b) * STEP)
        other = (hip[0] + (c - d) * STEP, hip[1] + (c + d) * STEP)
        if not -3.25 < one[1] < 0.05:
            continue
        q[at - 2 : at], q[at : at + 2] = one, other
        torque = -legs.torque(q)[at - 2 : at + 2]
        if one[1] > -0.25:  # on its stop
            torque[1] = min(torque[1], 0.0)
        best = min(best, (float(np.abs(torque).sum()), one, other))
    assert found["knee_right"].q in (None, pytest.approx(best[1], abs=1e-9))
    assert found["hip_right"].q in (None, pytest.approx(best[2], abs=1e-9))
    assert found["hip_right"].q is not None or "second pose" in found["hip_right"].why
