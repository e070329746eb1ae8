"""Statics of many moments against the law's own feedforward, which knows nothing of them."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from shared.arrays import Array
from shared.config.robot_config import GRAVITY, RobotConfig
from tests.planner.states import closed
from tools.bringup.identify.body_statics import Balance, BodyStatics, rotation_vector

UP = np.array([0.0, 0.0, 1.0])
POSES = (
    {"height": 1.188},
    {"height": 1.0, "pitch": 0.5, "x": 0.03, "y": -0.02, "roll": 0.06, "yaw": 0.08},
    {"height": 0.85, "pitch": 1.0, "x": -0.03, "y": 0.04, "roll": -0.05, "yaw": -0.05},
)


@pytest.fixture
def poses() -> Array:
    return np.array([closed(**pose) for pose in POSES])


def balance(robot: RobotConfig, q: Array, tau: Array, force_up: float = 0.0) -> Balance:
    """Return the balance with an upward force of the person at the harness point, N."""
    rows = []
    for one in q:
        kinematics = Kinematics(robot)
        kinematics.update(one)
        roll, pitch = kinematics.p[3:5]
        rows.append([-np.cos(roll) * np.sin(pitch), np.sin(roll), np.cos(roll) * np.cos(pitch)])
    force = force_up * np.array(rows)
    arm = np.array(robot.geometry.harness_point)
    return BodyStatics(robot).balance(
        q, tau, UP, mass=robot.torso_mass, moment=np.zeros(3),
        force=force, force_moment=np.cross(arm, force),
    )  # fmt: skip


@pytest.mark.parametrize("force", [0.0, -100.0])
def test_the_laws_feedforward_balances_the_torso(
    robot: RobotConfig, poses: Array, force: float
) -> None:
    tau = []
    for q in poses:
        kinematics = Kinematics(robot)
        kinematics.update(q)
        weight = robot.total_mass * GRAVITY * kinematics.J[2]
        tau.append(weight - force * kinematics.J_harness[2])
    found = balance(robot, poses, np.array(tau), force)
    np.testing.assert_allclose(found.wrench, 0.0, atol=1e-4)


def test_without_torque_the_weight_is_left_over(robot: RobotConfig, poses: Array) -> None:
    found = balance(robot, poses[:1], np.zeros((1, 12)))
    assert found.wrench[0, 2] < -robot.torso_mass * GRAVITY


def test_the_left_foot_is_where_the_robot_file_has_it_at_every_closed_pose(
    robot: RobotConfig, poses: Array
) -> None:
    found = balance(robot, poses, np.zeros_like(poses))
    wanted = [0.0, 0.0, 0.0, 0.0, robot.geometry.w_base, 0.0]
    np.testing.assert_allclose(found.feet, np.tile(wanted, (len(poses), 1)), atol=1e-6)


def test_a_wrong_ankle_moves_the_left_foot_against_the_right(
    robot: RobotConfig, poses: Array
) -> None:
    wrong = poses.copy()
    wrong[:, 1] += 0.01  # the right ankle's theta
    by = balance(robot, wrong, np.zeros_like(poses)).feet[:, 1]
    np.testing.assert_allclose(by, 0.01, atol=2e-3)


def test_a_small_turn_is_its_rotation_vector() -> None:
    angle = 0.1
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0, 0, 1.0]]
    )
    np.testing.assert_allclose(rotation_vector(turn[None]), [[0.0, 0.0, angle]], atol=1e-6)
