"""q_ref = IK(p_ref) with both feet on the ground."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.planner.inverse_kinematics import TOLERANCE, InverseKinematics
from shared.config import RobotConfig
from shared.robot_model import stand_pose
from tests.planner import oracle
from tests.planner.conftest import Closed, com_height, p_at
from tests.planner.oracle import Array

KNEES = (3, 9)


def true_residual(robot: RobotConfig, q: Array, p_ref: Array) -> float:
    """Return the largest error in p or in the closure by the oracle, m or rad."""
    errors = (oracle.pose(robot, q) - p_ref, oracle.closure(robot, q))
    return float(max(np.abs(error).max() for error in errors))


def assert_within(q: Array, limits: Array) -> None:
    assert np.all(q >= limits[:, 0])
    assert np.all(q <= limits[:, 1])


def test_the_stand_converges_to_any_pose_of_the_workspace(
    robot: RobotConfig, ik: InverseKinematics, limits: Array, closed: Closed
) -> None:
    """Torso 0.85..1.20 m with every offset; nearer the ends a leg cannot reach them all."""
    rng = np.random.default_rng(11)
    stand = closed(1.188)
    for _ in range(100):
        x, y = rng.uniform(-0.06, 0.06, 2)
        roll, yaw = rng.uniform(-0.1, 0.1, 2)
        height, pitch = rng.uniform(0.85, 1.20), rng.uniform(-0.2, 1.2)
        p_ref = p_at(robot, height, x=x, y=y, roll=roll, pitch=pitch, yaw=yaw)
        ik.q[:] = stand
        result = ik.solve(p_ref, iterations_max=60)
        assert result.converged, f"{p_ref}: {result}"
        assert true_residual(robot, ik.q, p_ref) <= 2 * TOLERANCE, f"{p_ref}: {result}"
        assert ik.q[list(KNEES)].max() <= -0.2  # bent backwards, as the limits have it
        assert_within(ik.q, limits)


@pytest.mark.parametrize(("height", "pitch"), [(0.80, 0.0), (0.80, 1.2), (1.25, 0.0), (1.25, 1.2)])
def test_the_ends_of_the_workspace_are_reached(
    robot: RobotConfig,
    ik: InverseKinematics,
    limits: Array,
    closed: Closed,
    height: float,
    pitch: float,
) -> None:
    p_ref = p_at(robot, height, pitch=pitch)
    ik.q[:] = closed(1.188)
    assert ik.solve(p_ref, iterations_max=60).converged
    assert true_residual(robot, ik.q, p_ref) <= 2 * TOLERANCE
    assert_within(ik.q, limits)


def test_a_squat_takes_at_most_two_iterations_a_tick(
    robot: RobotConfig, ik: InverseKinematics, closed: Closed
) -> None:
    ik.q[:] = closed(1.188)
    for tick in range(1250):  # 5 s at 250 Hz
        phase = 2 * math.pi * tick / 1250
        z = com_height(robot, 1.188 - 0.12 * (1 - math.cos(phase)))
        p_ref = np.array([0.0, 0.0, z, 0.0, 0.1 * math.sin(phase), 0.0])
        result = ik.solve(p_ref)
        assert result.iterations <= 2
        assert result.converged
        assert true_residual(robot, ik.q, p_ref) <= 2 * TOLERANCE


def test_an_unreachable_pose_keeps_the_limits_and_says_so(
    robot: RobotConfig, ik: InverseKinematics, limits: Array, closed: Closed
) -> None:
    ik.q[:] = closed(1.188)
    p_ref = np.array([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    for _ in range(50):
        result = ik.solve(p_ref)
        assert np.isfinite(ik.q).all()
        assert_within(ik.q, limits)
        assert not result.converged


def test_an_unreachable_pose_does_not_make_it_worse_than_where_it_started(
    robot: RobotConfig, ik: InverseKinematics, closed: Closed
) -> None:
    """Does not diverge: the stand itself is 0.63 m off."""
    ik.q[:] = closed(1.188)
    p_ref = np.array([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    at_start = true_residual(robot, ik.q, p_ref)
    for _ in range(50):
        ik.solve(p_ref)
    assert true_residual(robot, ik.q, p_ref) <= at_start


def test_a_pose_just_out_of_reach_and_back_ends_where_it_began(
    robot: RobotConfig, ik: InverseKinematics, closed: Closed
) -> None:
    """The COM led 1 mm above what the knees' limit allows (0.9269 m), and down again."""
    stand = closed(1.188)
    low = float(oracle.pose(robot, stand)[2])
    ik.q[:] = stand
    up = np.linspace(low, 0.928, 250)
    for z in (*up, *([0.928] * 250), *up[::-1]):
        ik.solve(np.array([0.0, 0.0, z, 0.0, 0.0, 0.0]))
    assert np.abs(ik.q - stand).max() < 1e-4


def test_the_residual_is_true_where_a_limit_stops_the_step(
    robot: RobotConfig, ik: InverseKinematics, closed: Closed
) -> None:
    """A pose crept beyond the knee's limit must not be reported as reached."""
    ik.q[:] = closed(1.25)
    start = float(oracle.pose(robot, ik.q)[2])
    for z in np.arange(start, 0.9271, 1e-5):
        p_ref = np.array([0.0, 0.0, z, 0.0, 0.0, 0.0])
        result = ik.solve(p_ref)
        if result.converged:
            assert true_residual(robot, ik.q, p_ref) <= 10 * TOLERANCE, f"z = {z:.5f}: {result}"
    assert ik.q[KNEES[0]] == pytest.approx(-0.2, abs=1e-3)  # the limit was met


def test_the_kinematics_are_left_at_the_solution(
    robot: RobotConfig, ik: InverseKinematics, closed: Closed
) -> None:
    p_ref = p_at(robot, 1.0, pitch=0.3)
    ik.q[:] = closed(1.188)
    ik.solve(p_ref, iterations_max=60)
    assert np.abs(ik.kinematics.p - p_ref).max() < 1e-3


def test_stand_pose_is_level_with_its_com_over_the_ankles(robot: RobotConfig) -> None:
    for height in (0.85, 0.948, 1.188, 1.25):
        p = oracle.pose(robot, np.array(stand_pose(robot, height)))
        np.testing.assert_allclose(p[[0, 3, 4, 5]], 0.0, atol=1e-9)
