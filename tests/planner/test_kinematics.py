"""p, J, closure, load sharing and sum_i H_i F_i against the paper's equations and differences."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from shared.arrays import Array
from shared.config.gain_schedule import inputs_of
from shared.config.robot_config import RobotConfig
from shared.robot.robot_model import stand_pose
from tests.planner import oracle
from tests.planner.oracle import LEFT, RIGHT
from tests.planner.states import ROBOT, SQUAT, WEIGHT, Stand, closed
from tools.reach import ReachSolver

POSES = (
    {"height": 1.188},
    {"height": 1.0, "pitch": 0.5, "x": 0.03, "y": -0.02, "roll": 0.05, "yaw": 0.05},
    {"height": 0.85, "pitch": 1.0, "x": -0.03, "y": 0.04, "roll": -0.05, "yaw": -0.05},
    {"height": 0.80, "pitch": 1.2},
)


@pytest.fixture(params=POSES, ids=lambda p: f"{p['height']:g}m-{p.get('pitch', 0):g}rad")
def q(request: pytest.FixtureRequest) -> Array:
    return closed(**request.param)


def slope(kinematics: Kinematics, name: str, q: Array, D_left: Array | None = None) -> Array:
    """Return the central difference of one of the kinematics' vectors by q."""

    def value(q_near: Array) -> Array:
        kinematics.update(q_near, D_left)
        return np.array(getattr(kinematics, name))

    return oracle.derivative(value, q)


def test_pose_closure_and_harness_are_the_papers_where_the_legs_agree(
    kinematics: Kinematics, q: Array
) -> None:
    kinematics.update(q)
    for side in (RIGHT, LEFT):
        np.testing.assert_allclose(kinematics.p, oracle.pose(ROBOT, q, side), atol=1e-8)
        np.testing.assert_allclose(kinematics.r_harness, oracle.harness(ROBOT, q, side), atol=1e-8)
        np.testing.assert_allclose(kinematics.r_torso, oracle.leg(ROBOT, side, q).torso, atol=1e-8)
    np.testing.assert_allclose(kinematics.closure, 0.0, atol=1e-8)


@pytest.mark.parametrize("opening", [1e-3, 1e-2])
def test_closure_is_the_legs_disagreement_when_they_are_open(
    kinematics: Kinematics, q: Array, opening: float
) -> None:
    q_open = q + opening * np.random.default_rng(5).normal(size=12)
    kinematics.update(q_open)
    assert np.abs(kinematics.closure).max() > opening / 2
    np.testing.assert_allclose(kinematics.closure, oracle.closure(ROBOT, q_open), atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "vector"), [("J", "p"), ("C", "closure"), ("J_harness", "r_harness")]
)
@pytest.mark.parametrize("opening", [0.0, 1e-4, 1e-3, 1e-2])
def test_jacobians_are_slopes_and_err_by_no_more_than_the_opening_of_the_legs(
    kinematics: Kinematics, q: Array, matrix: str, vector: str, opening: float
) -> None:
    """To first order in the closure: J mixes twists, p mixes a rotation vector."""
    q_open = q + opening * np.random.default_rng(5).normal(size=12)
    kinematics.update(q_open)
    got, D_left = np.array(getattr(kinematics, matrix)), kinematics.D_left.copy()
    most = 1.5 * np.abs(kinematics.closure).max() if opening else 1e-7
    held = D_left if opening else None
    np.testing.assert_allclose(got, slope(kinematics, vector, q_open, held), atol=most)


def test_the_legs_shares_sum_to_one(kinematics: Kinematics, q: Array) -> None:
    """D_R + D_L = I, D_R by the same formula from the right foot (docs/law.md#load-sharing)."""
    kinematics.update(q)
    share_x, share_y, l_z = ROBOT.law.load_sharing_moment_arms
    l_x, l_y = share_x * ROBOT.geometry.l_foot / 2, share_y * ROBOT.geometry.w_foot / 2
    W = np.diag([1.0, 1.0, 1.0, l_y**2, l_x**2, l_z**2])
    weighted = []
    for side in (RIGHT, LEFT):
        leg = oracle.leg(ROBOT, side, q)
        x, y, z = leg.ankle - leg.torso
        X = np.eye(6)
        X[3:, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        weighted.append(X @ W @ X.T)
    D_right, D_left = (w @ np.linalg.inv(sum(weighted)) for w in weighted)
    np.testing.assert_allclose(D_right + D_left, np.eye(6), atol=1e-9)
    np.testing.assert_allclose(kinematics.D_left, D_left, atol=1e-7)


def ankle_roll_moment(J_torso_z: Array, side: int, q: Array) -> Array:
    """Return a foot's wrench when the legs give the torso 1 N upward and weigh nothing."""
    w = np.linalg.solve(oracle.leg_jacobian(ROBOT, side, q).T, J_torso_z[oracle.LEG[side]])
    leg = oracle.leg(ROBOT, side, q)
    return np.concatenate([w[:3], w[3:] + np.cross(leg.torso - leg.ankle, w[:3])])


def up_at_torso(kinematics: Kinematics) -> Array:
    """Return the joint torques (12,) that lift the torso's centre by 1 N.

    From J's COM rows with the knees' own part taken off again.
    """
    m_torso, m_total = oracle.masses(ROBOT)
    q = np.array(kinematics._pose.arguments[0])
    knees = np.concatenate([oracle.knee_jacobian(ROBOT, s, q)[2] for s in (RIGHT, LEFT)])
    return np.asarray((m_total * kinematics.J[2] - ROBOT.mass.module * knees) / m_torso, float)


def test_load_sharing_asks_each_foot_for_less_than_its_edge_gives_and_average_for_more(
    kinematics: Kinematics, averaging: Kinematics
) -> None:
    """Lifted at the torso, and under its own weight."""
    force = oracle.masses(ROBOT)[1] * oracle.GRAVITY
    weight = np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])
    asked, capacity = [], []
    for height in SQUAT:
        q = closed(height)
        for name, model in (("load_sharing", kinematics), ("average", averaging)):
            model.update(q)
            lift, bears = up_at_torso(model), model.J.T @ weight
            for side in (RIGHT, LEFT):
                lifted = force * ankle_roll_moment(lift, side, q)
                for foot in (lifted, oracle.foot_wrench(ROBOT, side, q, bears)):
                    edge = foot[2] * ROBOT.geometry.w_foot / 2
                    assert (abs(foot[3]) < edge) == (name == "load_sharing")
                asked.append(abs(lifted[3]))
                capacity.append(lifted[2] * ROBOT.geometry.w_foot / 2)
    assert max(asked) == pytest.approx(127, abs=1.0)  # docs/law.md#load-sharing
    assert min(capacity) == pytest.approx(23, abs=0.5)


NO_FORCE = np.zeros(3)
STEP = 1e-4
"""m and rad; of the second differences."""


# ---- sum_i H_i F_i against second differences of the oracle's closed chain


class Load(NamedTuple):
    """What the law asks of the joints: along p, and at the harness point."""

    F: Array
    F_harness: Array


def unit(index: int, size: float) -> Array:
    return np.asarray(size * np.eye(6)[index], float)


LOADS = {
    "weight": Load(WEIGHT, NO_FORCE),
    "force x": Load(unit(0, 100.0), NO_FORCE),
    "force y": Load(unit(1, 100.0), NO_FORCE),
    "roll": Load(unit(3, 50.0), NO_FORCE),
    "pitch": Load(unit(4, 50.0), NO_FORCE),
    "yaw": Load(unit(5, 50.0), NO_FORCE),
    "harness x": Load(np.zeros(6), np.array([100.0, 0.0, 0.0])),
    "harness y": Load(np.zeros(6), np.array([0.0, 100.0, 0.0])),
    "harness z": Load(np.zeros(6), np.array([0.0, 0.0, 200.0])),
    "all": Load(
        np.array([30.0, -20.0, 731.6, 10.0, -15.0, 5.0]), np.array([30.0, -60.0, 200.0])
    ),
}  # fmt: skip


@pytest.mark.parametrize("mixed", ["load_sharing", "average"])
def test_hessian_is_exact_along_the_closed_chain(
    kinematics: Kinematics, averaging: Kinematics, q: Array, mixed: str
) -> None:
    """T^T H T is the curvature by p of F_h . r_harness - tau . q(p), tau = J^T F + J_h^T F_h held.

    F . p itself does not curve. All kinds of load are told apart, to 5e-5 of the largest.
    """
    model = kinematics if mixed == "load_sharing" else averaging
    model.update(q)
    held = np.array([w.F @ model.J + w.F_harness @ model.J_harness for w in LOADS.values()])
    forces = np.array([w.F_harness for w in LOADS.values()])
    hessians = {name: model.hessian_times(*load).copy() for name, load in LOADS.items()}
    q_of, p = oracle.closed_chain(ROBOT, q), oracle.pose(ROBOT, q)

    def energy(p_near: Array) -> Array:
        q_near = q_of(p_near)
        return np.asarray(forces @ oracle.harness(ROBOT, q_near) - held @ q_near, float)

    curvature = oracle.second_derivative(energy, p, STEP)
    T = oracle.feasible(ROBOT, q)
    for index, (name, hessian) in enumerate(hessians.items()):
        got, want = T.T @ hessian @ T, curvature[index]
        largest = np.abs(want).max()
        assert largest > 5.0, name
        np.testing.assert_allclose(got, want, atol=5e-5 * largest, err_msg=name)


def test_hessian_is_symmetric_and_each_leg_has_its_own(kinematics: Kinematics, q: Array) -> None:
    kinematics.update(q)
    for load in LOADS.values():
        hessian = kinematics.hessian_times(*load)
        assert np.abs(hessian).max() > 5.0
        np.testing.assert_allclose(hessian, hessian.T, atol=1e-9)
        np.testing.assert_array_equal(hessian[:6, 6:], 0.0)
        np.testing.assert_array_equal(hessian[6:, :6], 0.0)


# ---- a payload off the torso's centre

PLACE = (0.08, -0.05, 0.15)


@pytest.fixture(scope="module")
def laden() -> RobotConfig:
    return msgspec.structs.replace(
        ROBOT, mass=msgspec.structs.replace(ROBOT.mass, payload_com=PLACE)
    )


@pytest.fixture(scope="module", params=[0.0, 0.6], ids=["upright", "pitched"])
def laden_q(request: pytest.FixtureRequest, laden: RobotConfig) -> Array:
    """Return a closed stand that leans and turns."""
    ik = ReachSolver(Kinematics(laden), np.array(laden.joint_limits()))
    ik.q[:] = stand_pose(laden, 1.0)
    p = np.array([0.02, -0.02, 0.86, 0.05, request.param, 0.06])
    assert ik.solve_from_anywhere(p).converged
    return ik.q.copy()


def test_a_payload_beside_is_in_pose_and_jacobian(laden: RobotConfig, laden_q: Array) -> None:
    kinematics = Kinematics(laden)
    kinematics.update(laden_q)
    np.testing.assert_allclose(kinematics.p, oracle.pose(laden, laden_q), atol=1e-7)
    T = oracle.feasible(laden, laden_q)
    np.testing.assert_allclose(kinematics.J @ T, np.eye(6), atol=1e-6)


def test_a_payload_beside_is_balanced_and_certified(laden: RobotConfig, laden_q: Array) -> None:
    stand = Stand(laden, laden_q, assist=80.0)
    D = np.tile([900.0, 1500.0, 3000.0, 3000.0, 3000.0, 900.0], 2)
    felt = stand.stiffness_felt(D)  # asserts balance
    np.testing.assert_allclose(
        stand.certificate.failsafe_stiffness(D), felt, atol=1e-4 * np.abs(felt).max()
    )


def test_a_centred_payload_leaves_the_schedule(laden: RobotConfig) -> None:
    assert "mass.payload_com" not in inputs_of(ROBOT)
    assert inputs_of(laden)["mass.payload_com"] == list(PLACE)
