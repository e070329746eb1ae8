"""q_ref = IK(p_ref) with both feet on the ground."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from services.planner.law.inverse_kinematics import TOLERANCE
from services.planner.law.kinematics import Kinematics
from shared.arrays import Array
from shared.robot.robot_model import stand_pose
from tests.planner import oracle
from tests.planner.states import LIMITS, ROBOT, closed, com_height, p_at
from tools.reach import IkEnding, ReachSolver, describe

KNEES = (3, 9)
HIGH = np.array([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
"""Out of reach: the stand is 0.63 m off."""


def true_residual(q: Array, p_ref: Array) -> float:
    """Return the largest error in p or in the closure by the oracle, m or rad."""
    errors = (oracle.pose(ROBOT, q) - p_ref, oracle.closure(ROBOT, q))
    return float(max(np.abs(error).max() for error in errors))


def assert_reached(ik: ReachSolver, p_ref: Array) -> None:
    assert true_residual(ik.q, p_ref) <= 2 * TOLERANCE, p_ref
    assert_within(ik.q)


def counted(monkeypatch: pytest.MonkeyPatch, ik: ReachSolver) -> list[int]:
    """Count in the list's only entry how often the kinematics are computed."""
    count, update = [0], ik.kinematics.update

    def counting(q: Array, D_left: Array | None = None) -> None:
        count[0] += 1
        update(q, D_left)

    monkeypatch.setattr(ik.kinematics, "update", counting)
    return count


def assert_within(q: Array) -> None:
    assert np.all(q >= LIMITS[:, 0])
    assert np.all(q <= LIMITS[:, 1])


def test_the_stand_converges_to_any_pose_of_the_workspace(ik: ReachSolver) -> None:
    """Torso 0.85..1.20 m with every offset; nearer the ends a leg cannot reach them all."""
    rng = np.random.default_rng(11)
    stand = closed(1.188)
    poses = []
    for _ in range(100):
        x, y = rng.uniform(-0.06, 0.06, 2)
        roll, yaw = rng.uniform(-0.1, 0.1, 2)
        height, pitch = rng.uniform(0.85, 1.20), rng.uniform(-0.2, 1.2)
        poses.append(p_at(ROBOT, height, x=x, y=y, roll=roll, pitch=pitch, yaw=yaw))
    ends = itertools.product((0.80, 1.25), (0.0, 1.2))
    for p_ref in (*poses, *(p_at(ROBOT, height, pitch=pitch) for height, pitch in ends)):
        ik.q[:] = stand
        assert ik.solve(p_ref, iterations_max=60).converged, p_ref
        assert_reached(ik, p_ref)
        assert ik.q[list(KNEES)].max() <= -0.2  # bent backwards, as the limits have it
        assert np.abs(ik.kinematics.p - p_ref).max() < 2e-3, "left a step before it at most"


def test_a_squat_takes_at_most_two_iterations_a_tick_and_as_many_kinematics(
    ik: ReachSolver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Warm, without a search."""
    ik.q[:] = closed(1.188)
    count = counted(monkeypatch, ik)
    for tick in range(1250):  # 5 s at 250 Hz
        phase, before = 2 * math.pi * tick / 1250, count[0]
        z = com_height(ROBOT, 1.188 - 0.12 * (1 - math.cos(phase)))
        p_ref = np.array([0.0, 0.0, z, 0.0, 0.1 * math.sin(phase), 0.0])
        result = ik.solve(p_ref)
        assert result.converged
        assert max(result.iterations, count[0] - before) <= 2
        assert true_residual(ik.q, p_ref) <= 2 * TOLERANCE


def test_out_of_reach_a_tick_computes_the_kinematics_three_times(
    ik: ReachSolver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third takes back a step that led nowhere, once it is at a limit."""
    ik.q[:] = closed(0.948)
    count = counted(monkeypatch, ik)
    for tick in range(110):
        before = count[0]
        ik.solve(HIGH)
        assert count[0] - before <= (5 if tick < 10 else 3)


def test_an_unreachable_pose_keeps_the_limits_is_reported_and_ends_no_worse_than_it_began(
    ik: ReachSolver,
) -> None:
    ik.q[:] = closed(1.188)
    at_start = true_residual(ik.q, HIGH)
    for _ in range(50):
        assert not ik.solve(HIGH).converged
        assert np.isfinite(ik.q).all()
        assert_within(ik.q)
    assert true_residual(ik.q, HIGH) <= at_start


def test_the_residual_is_true_where_a_limit_stops_the_step(ik: ReachSolver) -> None:
    """A pose crept beyond the knee's limit must not be reported as reached."""
    ik.q[:] = closed(1.25)
    start = float(oracle.pose(ROBOT, ik.q)[2])
    for z in np.arange(start, 0.9271, 1e-5):
        p_ref = np.array([0.0, 0.0, z, 0.0, 0.0, 0.0])
        result = ik.solve(p_ref)
        if result.converged:
            assert true_residual(ik.q, p_ref) <= 10 * TOLERANCE, f"z = {z:.5f}: {result}"
    assert ik.q[KNEES[0]] == pytest.approx(-0.2, abs=1e-3)  # the limit was met


def test_stand_pose_is_level_with_its_com_over_the_ankles() -> None:
    for height in (0.85, 0.948, 1.188, 1.25):
        p = oracle.pose(ROBOT, np.array(stand_pose(ROBOT, height)))
        np.testing.assert_allclose(p[[0, 3, 4, 5]], 0.0, atol=1e-9)


def reachable(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return (q, p) drawn inside the limits and the workspace, by the oracle alone.

    The right leg's joints are drawn; the left leg is brought to carry the same torso by
    Newton's method; what leaves the limits or the workspace is drawn again.
    """
    low, high = LIMITS[:6].T
    while True:
        roll, pitch = rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 1.3)
        right = rng.uniform(low, high)
        right[[0, 2]] = rng.uniform(-0.25, 0.25), rng.uniform(-0.4, 0.4)
        right[4] = roll - right[0] - right[2] + rng.uniform(-0.1, 0.1)
        right[5] = pitch - right[1] - right[3]
        q = np.concatenate([right, right])
        torso, yaw = oracle.leg(ROBOT, oracle.RIGHT, q).torso, oracle.pose(ROBOT, q)[5]
        if not 0.75 <= torso[2] <= 1.25 or abs(torso[0]) > 0.3 or abs(yaw) > 0.3:
            continue
        for _ in range(8):
            J = oracle.leg_jacobian(ROBOT, oracle.LEFT, q)
            q[6:] -= np.clip(np.linalg.solve(J, oracle.closure(ROBOT, q)), -0.4, 0.4)
        p = oracle.pose(ROBOT, q)
        inside = np.all((q >= LIMITS[:, 0]) & (q <= LIMITS[:, 1]))
        most = np.array([0.1, 0.1, 2.0, 0.2, 1.3, 0.3])
        closed = np.abs(oracle.closure(ROBOT, q)).max() < 1e-9
        if inside and closed and np.all(np.abs(p) <= most) and p[4] >= -0.3:
            return q, p


def test_every_reachable_pose_is_reached_from_any_start_inside_the_limits(
    ik: ReachSolver,
) -> None:
    """None of 7 500 such poses failed, each from a random start and from a stand."""
    rng = np.random.default_rng(2024)
    for _ in range(12):
        _, p_ref = reachable(rng)
        for _ in range(4):
            ik.q[:] = rng.uniform(LIMITS[:, 0], LIMITS[:, 1])
            reach = ik.solve_from_anywhere(p_ref)
            assert reach.converged, describe(reach, p_ref, LIMITS)
            assert_reached(ik, p_ref)


UNREACHABLE = {
    "too high, twisted": (0.05, -0.03, 1.1, 0.1, 0.4, 0.15),
    "below the floor": (0.0, 0.0, -0.3, 0.0, 0.2, 0.0),
    "too far ahead": (1.2, 0.0, 0.8, 0.0, 0.0, 0.0),
    "too far to the left": (0.0, 0.9, 0.8, 0.1, 0.0, 0.0),
    "too far rolled": (0.0, 0.0, 0.8, -0.9, 0.0, 0.0),
    "too far turned": (0.0, 0.0, 0.85, 0.0, 0.3, 1.4),
    "bent too far back": (0.0, 0.0, 0.8, 0.0, -2.5, 0.0),
}


@pytest.fixture(params=UNREACHABLE.values(), ids=list(UNREACHABLE))
def p_unreachable(request: pytest.FixtureRequest) -> Array:
    return np.array(request.param)


def test_out_of_reach_it_ends_inside_the_limits_with_legs_that_agree(
    ik: ReachSolver, p_unreachable: Array
) -> None:
    rng, misses = np.random.default_rng(3), []
    for start in (rng.uniform(*LIMITS.T), closed(1.188), closed(0.85, pitch=1.0)):
        ik.q[:] = start
        reach = ik.solve_from_anywhere(p_unreachable)
        assert reach.outcome in (IkEnding.JOINT_LIMIT, IkEnding.OUT_OF_REACH)
        assert np.isfinite(ik.q).all()
        assert_within(ik.q)
        assert np.abs(oracle.closure(ROBOT, ik.q)).max() < 1e-5
        np.testing.assert_allclose(
            p_unreachable - oracle.pose(ROBOT, ik.q), reach.error, atol=2 * TOLERANCE
        )
        misses.append(float(np.linalg.norm(reach.error)))
    assert misses[1] == pytest.approx(misses[2], abs=1e-5)  # any stand ends as near


TOO_HIGH = np.array([0.0, 0.0, 1.31, 0.0, 0.0, 0.0])


def test_too_high_names_how_far_it_goes_and_which_joints_stop_it(ik: ReachSolver) -> None:
    ik.q[:] = closed(1.188)
    reach = ik.solve_from_anywhere(TOO_HIGH)
    assert reach.outcome is IkEnding.JOINT_LIMIT
    assert reach.stopped == (0, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0)
    assert describe(reach, TOO_HIGH, LIMITS) == (
        "p_ref cannot be reached: COM z 1.31 m requested, 0.93 m is the closest: "
        "knee_right_theta at its limit -0.2 rad, knee_left_theta at its limit -0.2 rad"
    )
    wide = LIMITS.copy()
    wide[list(KNEES), 1] = 0.3
    beyond = ReachSolver(Kinematics(ROBOT), wide)
    beyond.q[:] = stand_pose(ROBOT, 1.188)
    reach = beyond.solve_from_anywhere(TOO_HIGH)
    assert (reach.outcome, set(reach.stopped)) == (IkEnding.OUT_OF_REACH, {0}), "straight legs"
    assert describe(reach, TOO_HIGH, wide).endswith(
        "reach no further, and no joint is at its limit"
    )
