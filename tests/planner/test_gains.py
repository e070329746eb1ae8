"""K_q = N K_0 + J^T K_p J - sum_i H_i F_i, B_q = N B_0 + J^T B_p J."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from services.planner.law.gains import GainLaw, JointGains
from services.planner.law.kinematics import Kinematics
from shared.config.robot_config import RobotConfig
from tests.planner.conftest import Closed
from tests.planner.oracle import Array

WEIGHT = np.array([0.0, 0.0, 731.6, 0.0, 0.0, 0.0])
NO_HESSIAN = np.zeros((12, 12))
OPEN = (2, 4)
"""z and pitch, where the person leads."""

POSES = ((1.25, 0.0), (1.188, 0.0), (0.948, 0.0), (0.85, 0.6), (0.80, 1.2))


@pytest.fixture(params=POSES, ids=lambda p: f"{p[0]:g}m-{p[1]:g}rad")
def at(request: pytest.FixtureRequest, kinematics: Kinematics, closed: Closed) -> Kinematics:
    height, pitch = request.param
    kinematics.update(closed(height, pitch=pitch))
    return kinematics


def gains_under_weight(robot: RobotConfig, at: Kinematics) -> JointGains:
    return GainLaw(robot).gains(at, at.hessian_times(WEIGHT, np.array([0.0, 0.0, 200.0])))


def null_space(robot: RobotConfig, at: Kinematics) -> Array:
    """Return N (12, 12) as the law uses it: with no K_p, K_q = N K_0."""
    law = msgspec.structs.replace(robot.law, K_p=(0.0,) * 6, K_0=1.0)
    return GainLaw(msgspec.structs.replace(robot, law=law)).gains(at, NO_HESSIAN).K_q


def test_gains_are_symmetric(robot: RobotConfig, at: Kinematics) -> None:
    gains = gains_under_weight(robot, at)
    np.testing.assert_array_equal(gains.K_q, gains.K_q.T)
    np.testing.assert_array_equal(gains.B_q, gains.B_q.T)


def test_gains_are_the_papers_sum(robot: RobotConfig, at: Kinematics) -> None:
    law, J = robot.law, at.J.copy()
    hessian = at.hessian_times(WEIGHT, np.zeros(3)).copy()
    gains = GainLaw(robot).gains(at, hessian)
    closed = 1.0 - np.array(law.S)
    N = null_space(robot, at)
    K_q = law.K_0 * N + J.T @ np.diag(law.K_p * closed) @ J - hessian
    B_q = law.B_0 * N + J.T @ np.diag(law.B_p * closed) @ J
    np.testing.assert_allclose(gains.K_q, K_q, atol=1e-9)
    np.testing.assert_allclose(gains.B_q, B_q, atol=1e-9)


def test_k_p_in_an_open_direction_is_filtered_out(robot: RobotConfig, at: Kinematics) -> None:
    K_p = tuple(2000.0 if i in OPEN else k for i, k in enumerate(robot.law.K_p))
    stiff = msgspec.structs.replace(robot.law, K_p=K_p)
    same = GainLaw(msgspec.structs.replace(robot, law=stiff)).gains(at, NO_HESSIAN)
    np.testing.assert_array_equal(same.K_q, GainLaw(robot).gains(at, NO_HESSIAN).K_q)


def test_unloaded_stiffness_in_the_range_of_j_is_k_p_and_a_known_leak(
    robot: RobotConfig, at: Kinematics
) -> None:
    """Holds exactly: (J^+)^T K_q J^+ = K_p + K_0 lambda^2 (A (A + lambda^2 I))^-1, A = J J^T."""
    gains = GainLaw(robot).gains(at, NO_HESSIAN)
    J_plus, A = np.linalg.pinv(at.J), at.J @ at.J.T
    damping = robot.law.damping_lambda**2
    leak = robot.law.K_0 * damping * np.linalg.inv(A @ (A + damping * np.eye(6)))
    K_p = np.diag(np.where(np.array(robot.law.S) == 1, 0.0, robot.law.K_p))
    np.testing.assert_allclose(J_plus.T @ gains.K_q @ J_plus, K_p + leak, rtol=1e-6, atol=1e-6)


def test_undamped_there_is_no_stiffness_in_the_open_directions(
    robot: RobotConfig, at: Kinematics
) -> None:
    law = msgspec.structs.replace(robot.law, damping_lambda=1e-6)
    gains = GainLaw(msgspec.structs.replace(robot, law=law)).gains(at, NO_HESSIAN)
    J_plus = np.linalg.pinv(at.J)
    K_x, B_x = J_plus.T @ gains.K_q @ J_plus, J_plus.T @ gains.B_q @ J_plus
    for open_direction in OPEN:
        np.testing.assert_allclose(K_x[open_direction], 0.0, atol=1e-3)
        np.testing.assert_allclose(B_x[open_direction], 0.0, atol=1e-3)


def test_null_space_projector_keeps_clear_of_the_task_up_to_its_damping(
    robot: RobotConfig, at: Kinematics
) -> None:
    """Singular values of J N are s lambda^2 / (s^2 + lambda^2), at most lambda / 2."""
    N = null_space(robot, at)
    values = np.linalg.eigvalsh(N)
    assert values.min() >= -1e-12
    assert values.max() <= 1.0 + 1e-12
    assert np.sum(values > 1 - 1e-9) == 6  # the six directions that J does not see are whole
    assert np.linalg.norm(at.J @ N, 2) <= robot.law.damping_lambda / 2 + 1e-12
