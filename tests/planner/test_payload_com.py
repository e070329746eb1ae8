"""A payload off the torso's centre: model, law and loads know where it is."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from services.planner.law.inverse_kinematics import InverseKinematics
from services.planner.law.kinematics import Kinematics
from shared.config.gain_schedule import inputs_of
from shared.config.robot_config import RobotConfig
from shared.robot.robot_model import stand_pose
from tests.planner import oracle
from tests.planner.oracle import Array
from tests.planner.stands import Stand
from tools.lab.design.push_limit import LoadedStand

PLACE = (0.08, -0.05, 0.15)
SIDES = (oracle.RIGHT, oracle.LEFT)


@pytest.fixture(scope="module")
def laden(robot: RobotConfig) -> RobotConfig:
    return msgspec.structs.replace(
        robot, mass=msgspec.structs.replace(robot.mass, payload_com=PLACE)
    )


@pytest.fixture(scope="module", params=[0.0, 0.6], ids=["upright", "pitched"])
def q(request: pytest.FixtureRequest, laden: RobotConfig) -> Array:
    """Return a closed stand that leans and turns."""
    ik = InverseKinematics(Kinematics(laden), np.array(laden.joint_limits()))
    ik.q[:] = stand_pose(laden, 1.0)
    p = np.array([0.02, -0.02, 0.86, 0.05, request.param, 0.06])
    assert ik.solve_from_anywhere(p).converged
    return ik.q.copy()


def test_pose_and_jacobian_are_the_papers_with_the_payload_beside(
    laden: RobotConfig, q: Array
) -> None:
    kinematics = Kinematics(laden)
    kinematics.update(q)
    np.testing.assert_allclose(kinematics.p, oracle.pose(laden, q), atol=1e-7)
    T = oracle.feasible(laden, q)
    np.testing.assert_allclose(kinematics.J @ T, np.eye(6), atol=1e-6)


def test_feedforward_balances_and_the_certificate_has_the_curvature_that_is_felt(
    laden: RobotConfig, q: Array
) -> None:
    stand = Stand(laden, q, assist=80.0)
    D = np.tile([900.0, 1500.0, 3000.0, 3000.0, 3000.0, 900.0], 2)
    felt = stand.stiffness_felt(D)  # asserts balance
    np.testing.assert_allclose(
        stand.certificate.failsafe_stiffness(D), felt, atol=1e-4 * np.abs(felt).max()
    )


def test_the_push_limits_knees_weigh_the_same_wherever_the_payload_is(
    robot: RobotConfig, laden: RobotConfig, q: Array
) -> None:
    knees = []
    for config in (robot, laden):
        kinematics = Kinematics(config)
        kinematics.update(q)
        knees.append(LoadedStand(config, kinematics, np.zeros((12, 6)), np.zeros((12, 12))))
    np.testing.assert_allclose(knees[0]._tau_knees, knees[1]._tau_knees, atol=1e-6)


def test_a_centred_payload_leaves_the_gain_schedule_what_it_was(
    robot: RobotConfig, laden: RobotConfig
) -> None:
    assert "mass.payload_com" not in inputs_of(robot)
    assert inputs_of(laden)["mass.payload_com"] == list(PLACE)
