"""p, J, closure and load sharing against the paper's equations; test_hessian.py has the rest."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from shared.config.robot_config import RobotConfig
from tests.planner import oracle
from tests.planner.conftest import SQUAT, Closed
from tests.planner.oracle import LEFT, RIGHT, Array

POSES = (
    {"height": 1.188},
    {"height": 1.0, "pitch": 0.5, "x": 0.03, "y": -0.02, "roll": 0.05, "yaw": 0.05},
    {"height": 0.85, "pitch": 1.0, "x": -0.03, "y": 0.04, "roll": -0.05, "yaw": -0.05},
    {"height": 0.80, "pitch": 1.2},
)


@pytest.fixture(params=POSES, ids=lambda p: f"{p['height']:g}m-{p.get('pitch', 0):g}rad")
def q(request: pytest.FixtureRequest, closed: Closed) -> Array:
    return closed(**request.param)


def slope(kinematics: Kinematics, name: str, q: Array, D_left: Array | None = None) -> Array:
    """Return the central difference of one of the kinematics' vectors by q."""

    def value(q_near: Array) -> Array:
        kinematics.update(q_near, D_left)
        return np.array(getattr(kinematics, name))

    return oracle.derivative(value, q)


def test_pose_closure_and_harness_are_the_papers_where_the_legs_agree(
    robot: RobotConfig, kinematics: Kinematics, q: Array
) -> None:
    kinematics.update(q)
    for side in (RIGHT, LEFT):
        np.testing.assert_allclose(kinematics.p, oracle.pose(robot, q, side), atol=1e-8)
        np.testing.assert_allclose(kinematics.r_harness, oracle.harness(robot, q, side), atol=1e-8)
        np.testing.assert_allclose(kinematics.r_torso, oracle.leg(robot, side, q).torso, atol=1e-8)
    np.testing.assert_allclose(kinematics.closure, 0.0, atol=1e-8)


@pytest.mark.parametrize("opening", [1e-3, 1e-2])
def test_closure_is_the_legs_disagreement_when_they_are_open(
    robot: RobotConfig, kinematics: Kinematics, q: Array, opening: float
) -> None:
    q_open = q + opening * np.random.default_rng(5).normal(size=12)
    kinematics.update(q_open)
    assert np.abs(kinematics.closure).max() > opening / 2
    np.testing.assert_allclose(kinematics.closure, oracle.closure(robot, q_open), atol=1e-9)


def test_an_open_pose_lies_between_the_poses_of_the_legs(
    robot: RobotConfig, averaging: Kinematics, q: Array
) -> None:
    q_open = q + 1e-3 * np.random.default_rng(5).normal(size=12)
    averaging.update(q_open)
    middle = 0.5 * (oracle.pose(robot, q_open, RIGHT) + oracle.pose(robot, q_open, LEFT))
    np.testing.assert_allclose(averaging.p, middle, atol=1e-5)


@pytest.mark.parametrize(
    ("matrix", "vector"), [("J", "p"), ("C", "closure"), ("J_harness", "r_harness")]
)
def test_jacobians_are_slopes_where_the_legs_agree(
    kinematics: Kinematics, q: Array, matrix: str, vector: str
) -> None:
    kinematics.update(q)
    got = np.array(getattr(kinematics, matrix))
    np.testing.assert_allclose(got, slope(kinematics, vector, q), atol=1e-7)


@pytest.mark.parametrize(
    ("matrix", "vector"), [("J", "p"), ("C", "closure"), ("J_harness", "r_harness")]
)
@pytest.mark.parametrize("opening", [1e-4, 1e-3, 1e-2])
def test_jacobians_err_by_no_more_than_the_opening_of_the_legs(
    kinematics: Kinematics, q: Array, matrix: str, vector: str, opening: float
) -> None:
    """To first order in the closure: J mixes twists, p mixes a rotation vector."""
    q_open = q + opening * np.random.default_rng(5).normal(size=12)
    kinematics.update(q_open)
    got, D_left = np.array(getattr(kinematics, matrix)), kinematics.D_left.copy()
    opened = np.abs(kinematics.closure).max()
    np.testing.assert_allclose(got, slope(kinematics, vector, q_open, D_left), atol=1.5 * opened)


def test_the_legs_shares_sum_to_one(robot: RobotConfig, kinematics: Kinematics, q: Array) -> None:
    """D_R + D_L = I, D_R by the same formula from the right foot (docs/law.md#load-sharing)."""
    kinematics.update(q)
    share_x, share_y, l_z = robot.law.load_sharing_moment_arms
    l_x, l_y = share_x * robot.geometry.l_foot / 2, share_y * robot.geometry.w_foot / 2
    W = np.diag([1.0, 1.0, 1.0, l_y**2, l_x**2, l_z**2])
    weighted = []
    for side in (RIGHT, LEFT):
        leg = oracle.leg(robot, side, q)
        x, y, z = leg.ankle - leg.torso
        X = np.eye(6)
        X[3:, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        weighted.append(X @ W @ X.T)
    D_right, D_left = (w @ np.linalg.inv(sum(weighted)) for w in weighted)
    np.testing.assert_allclose(D_right + D_left, np.eye(6), atol=1e-9)
    np.testing.assert_allclose(kinematics.D_left, D_left, atol=1e-7)


def ankle_roll_moment(robot: RobotConfig, J_torso_z: Array, side: int, q: Array) -> Array:
    """Return a foot's wrench when the legs give the torso 1 N upward and weigh nothing."""
    w = np.linalg.solve(oracle.leg_jacobian(robot, side, q).T, J_torso_z[oracle.LEG[side]])
    leg = oracle.leg(robot, side, q)
    return np.concatenate([w[:3], w[3:] + np.cross(leg.torso - leg.ankle, w[:3])])


def up_at_torso(robot: RobotConfig, kinematics: Kinematics) -> Array:
    """Return the joint torques (12,) that lift the torso's centre by 1 N.

    From J's COM rows with the knees' own part taken off again.
    """
    m_torso, m_total = oracle.masses(robot)
    q = np.array(kinematics._pose.arguments[0])
    knees = np.concatenate([oracle.knee_jacobian(robot, s, q)[2] for s in (RIGHT, LEFT)])
    return np.asarray((m_total * kinematics.J[2] - robot.mass.module * knees) / m_torso, float)


def test_load_sharing_asks_each_foot_for_less_than_its_edge_gives_and_average_for_more(
    robot: RobotConfig, kinematics: Kinematics, averaging: Kinematics, closed: Closed
) -> None:
    force = oracle.masses(robot)[1] * oracle.GRAVITY
    asked: dict[str, list[float]] = {"load_sharing": [], "average": []}
    capacity = []
    for height in SQUAT:
        q = closed(height)
        for name, model in (("load_sharing", kinematics), ("average", averaging)):
            model.update(q)
            lift = up_at_torso(robot, model)
            for side in (RIGHT, LEFT):
                foot = force * ankle_roll_moment(robot, lift, side, q)
                edge = foot[2] * robot.geometry.w_foot / 2
                asked[name].append(abs(foot[3]))
                capacity.append(edge)
                assert (abs(foot[3]) < edge) == (name == "load_sharing")
    figures = (
        f"roll moment per foot under {force:.0f} N: load sharing {max(asked['load_sharing']):.1f},"
        f" average {max(asked['average']):.1f}, edge {min(capacity):.1f} N m"
    )
    print(figures)  # noqa: T201  # shown by pytest -rP
    assert max(asked["average"]) == pytest.approx(127, abs=1.0)  # docs/law.md#load-sharing
    assert min(capacity) == pytest.approx(23, abs=0.5)


def test_under_its_own_weight_load_sharing_stays_within_the_edge_and_average_does_not(
    robot: RobotConfig, kinematics: Kinematics, averaging: Kinematics, closed: Closed
) -> None:
    weight = np.array([0.0, 0.0, oracle.masses(robot)[1] * oracle.GRAVITY, 0.0, 0.0, 0.0])
    for height in SQUAT:
        q = closed(height)
        for name, model in (("load_sharing", kinematics), ("average", averaging)):
            model.update(q)
            for side in (RIGHT, LEFT):
                foot = oracle.foot_wrench(robot, side, q, model.J.T @ weight)
                edge = foot[2] * robot.geometry.w_foot / 2
                assert (abs(foot[3]) < edge) == (name == "load_sharing")
