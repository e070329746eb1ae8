"""Frames of the robot, and its URDF, against Pinocchio and the planner's kinematics."""

from __future__ import annotations

from typing import cast

import numpy as np
import pinocchio as pin
import pytest

from services.planner.law.kinematics import Kinematics
from services.planner.law.model import load_pinocchio, q_tree
from shared.bus.messages import Vector6
from shared.config.robot_config import RobotConfig
from shared.joints import JOINTS, MODULES
from shared.robot import frames
from shared.robot.robot_model import stand_pose
from shared.robot.robot_urdf import cross_of, urdf


def random_q(robot: RobotConfig, seed: int) -> list[float]:
    low, high = np.array(robot.joint_limits()).T
    drawn: list[float] = np.random.default_rng(seed).uniform(low, high).tolist()
    return drawn


def placed(model: pin.Model, q: list[float]) -> dict[str, pin.SE3]:
    """Return the pose of every frame in the torso."""
    values = pin.neutral(model)
    for name, angle in zip(JOINTS, q, strict=True):
        values[model.joints[model.getJointId(name)].idx_q] = angle
    data = model.createData()
    pin.framesForwardKinematics(model, data, values)
    return {frame.name: data.oMf[i] for i, frame in enumerate(model.frames)}


@pytest.mark.parametrize("seed", range(3))
def test_frames_and_urdf_are_where_the_model_of_planner_and_simulator_is(
    robot: RobotConfig, seed: int
) -> None:
    q = random_q(robot, seed)
    by_urdf = placed(pin.buildModelFromXML(urdf(robot)), q)
    torso = {"torso": (np.zeros(3), np.eye(3))}
    for row in frames.body_frames(robot.geometry, q):
        origin, rotation = torso[row.parent]
        R = pin.Quaternion(np.array(row.rotation)).toRotationMatrix()
        torso[row.child] = (origin + rotation @ row.position, rotation @ R)
    assert set(torso) == {"torso", "harness", *MODULES}
    for name, (origin, rotation) in torso.items():
        np.testing.assert_allclose(by_urdf[name].translation, origin, atol=1e-12)
        np.testing.assert_allclose(by_urdf[name].rotation, rotation, atol=1e-12)


def test_the_urdf_moves_like_the_model_of_the_planner(robot: RobotConfig) -> None:
    """Inertia matrix and gravity torques are equal: masses, their places and the joints' axes."""
    ours = pin.buildModelFromXML(urdf(robot), pin.JointModelFreeFlyer())
    theirs = load_pinocchio(robot)
    theirs.armature[:] = 0.0  # URDF has none
    q = np.array(random_q(robot, 7))
    numbers = q_tree(np.arange(1.0, 1.0 + len(JOINTS)), theirs)[7:]
    by_name = [ours.joints[ours.getJointId(name)].idx_q - 7 for name in JOINTS]
    found = []
    for model, places in ((ours, by_name), (theirs, np.argsort(numbers).tolist())):
        values = pin.neutral(model)
        values[[7 + place for place in places]] = q
        order = [*range(6), *(6 + place for place in places)]
        data = model.createData()
        M = pin.crba(model, data, values)
        M = np.triu(M) + np.triu(M, 1).T
        gravity = pin.computeGeneralizedGravity(model, data, values)
        found.append((M[np.ix_(order, order)], gravity[order]))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-9)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-9)


def test_the_urdf_names_each_joint_and_the_link_between_the_two_of_a_module(
    robot: RobotConfig,
) -> None:
    model = pin.buildModelFromXML(urdf(robot))
    assert {model.names[i] for i in range(1, model.njoints)} == set(JOINTS)
    links = {frame.name for frame in model.frames}
    assert {*MODULES, *map(cross_of, MODULES), "torso", "harness"} <= links
    low, high = np.array(robot.joint_limits()).T
    for name, lower, upper in zip(JOINTS, low, high, strict=True):
        at = model.joints[model.getJointId(name)].idx_q
        assert (model.lowerPositionLimit[at], model.upperPositionLimit[at]) == (lower, upper)


STANCES = [(0.0,) * 6, (0.03, -0.02, 0.01, 0.0, 0.0, 0.1)]


@pytest.mark.parametrize("stance", STANCES)
@pytest.mark.parametrize("height", [1.188, 0.95])
def test_the_torso_is_where_the_planners_kinematics_has_it(
    robot: RobotConfig, height: float, stance: tuple[float, ...]
) -> None:
    """Where the legs do not agree, either takes a mean of its own."""
    check_torso(robot, list(stand_pose(robot, height)), stance)


def check_torso(robot: RobotConfig, q: list[float], stance: tuple[float, ...]) -> float:
    """Compare the torso's pose with the planner's; return how far the legs disagree."""
    kinematics = Kinematics(robot)
    kinematics.stance[:] = stance
    kinematics.update(np.array(q))
    apart = float(np.abs(kinematics.closure).max())
    position, rotation = frames.torso_pose(robot.geometry, q, cast("Vector6", stance))
    np.testing.assert_allclose(position, kinematics.r_torso, atol=1e-9 + apart)
    roll, pitch, yaw = kinematics.p[3:]
    wanted = frames.torso_rotation((roll, pitch, yaw))
    assert abs(np.dot(rotation, wanted)) == pytest.approx(1.0, abs=1e-12 + apart**2)
    return apart
