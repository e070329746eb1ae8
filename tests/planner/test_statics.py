"""Standing still: what holds the weight, what the feet carry, and the law's own slopes."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from services.planner.law import inverse_kinematics, reference
from services.planner.law.hocca import Hocca, LawOutput
from services.planner.law.inverse_kinematics import InverseKinematics
from shared.config.robot_config import RobotConfig
from tests.planner import oracle
from tests.planner.conftest import Closed, at_pose, p_at
from tests.planner.oracle import LEFT, RIGHT, Array

DT = 0.004
STILL = np.zeros(12)
POSES = (
    {"height": 1.188},
    {"height": 1.0, "x": 0.02, "y": -0.015, "roll": 0.03, "pitch": 0.3, "yaw": 0.04},
    {"height": 0.948},
    {"height": 0.80, "pitch": 1.2},
)
SQUAT = [(height, 0.0) for height in np.linspace(1.188, 0.948, 13)]
CRAWL = [(1.188 - 0.398 * share, 1.2 * share) for share in np.linspace(0.0, 1.0, 13)]
"""docs/simulator.md#reference-scenario: torso height in m and pitch in rad."""


@pytest.fixture(params=POSES, ids=lambda p: f"{p['height']:g}m-{p.get('pitch', 0):g}rad")
def q(request: pytest.FixtureRequest, closed: Closed) -> Array:
    return closed(**request.param)


def torque(output: LawOutput, q: Array, v: Array = STILL) -> Array:
    """Return what the joint services apply from a command that is not aged."""
    spring = output.local.D * (output.q_ref - q)
    damper = output.local.D_B * (output.v_ref - v)
    return np.asarray(output.tau_ff + output.tau_unfiltered + spring + damper, float)


def settled(law: Hocca, q: Array, assist: float) -> LawOutput:
    """Return the law's output at rest at a pose, once all of the assist is given."""
    for _ in range(2000):
        if law.tick(q, STILL, assist, DT, align=True).assist == assist:
            return law.tick(q, STILL, assist, 0.0, align=True)
    raise AssertionError("the assist never came")


def weight_and_load(robot: RobotConfig, q: Array, assist: float) -> Array:
    """Return the slope (12,) of the potential energy of robot and operator's load, N m."""

    def energy(q_near: Array) -> Array:
        load = assist * oracle.harness(robot, q_near)[2]
        return np.array(oracle.potential_energy(robot, q_near) + load)

    return oracle.precise_derivative(energy, q)


def feet(robot: RobotConfig, q: Array, tau: Array) -> list[Array]:
    return [oracle.foot_wrench(robot, side, q, tau) for side in (RIGHT, LEFT)]


def about_origin(wrench: Array, at: Array) -> Array:
    """Return a wrench (6,) at a point with its moment about the world's origin."""
    return np.concatenate([wrench[:3], wrench[3:] + np.cross(at, wrench[:3])])


def on_the_feet(robot: RobotConfig, q: Array, tau: Array) -> Array:
    """Return the sum (6,) of both feet's wrenches, moment about the world's origin."""
    ankles = [oracle.leg(robot, side, q).ankle for side in (RIGHT, LEFT)]
    right, left = feet(robot, q, tau)
    return about_origin(right, ankles[0]) + about_origin(left, ankles[1])


def to_carry(robot: RobotConfig, q: Array, assist: float) -> Array:
    """Return the wrench (6,) that weight and operator's load ask of the floor."""
    weight = np.array([0.0, 0.0, oracle.masses(robot)[1] * oracle.GRAVITY, 0.0, 0.0, 0.0])
    lift = np.array([0.0, 0.0, assist, 0.0, 0.0, 0.0])
    r_com, r_harness = oracle.pose(robot, q)[:3], oracle.harness(robot, q)
    return about_origin(weight, r_com) + about_origin(lift, r_harness)


# -- balance ---------------------------------------------------------------------------


@pytest.mark.parametrize("assist", [0.0, 200.0])
def test_feedforward_is_exact_in_static_balance(
    robot: RobotConfig, q: Array, assist: float
) -> None:
    """T^T tau_ff = d(energy)/dp to 1e-9 N and N m, at the pose that the law itself takes."""
    output = settled(Hocca(robot), q, assist)
    np.testing.assert_allclose(output.q_ref, q, atol=1e-6)
    T = oracle.feasible(robot, q)
    held, wanted = T.T @ output.tau_ff, T.T @ weight_and_load(robot, q, assist)
    assert wanted[2] > 74.0 * oracle.GRAVITY + assist
    np.testing.assert_allclose(held, wanted, atol=1e-9)


@pytest.mark.parametrize("assist", [0.0, 200.0])
def test_the_feet_carry_the_weight_and_the_assist_and_their_moments(
    robot: RobotConfig, q: Array, assist: float
) -> None:
    """All six parts of the sum, about the world's origin."""
    output = settled(Hocca(robot), q, assist)
    got = on_the_feet(robot, q, torque(output, q))
    np.testing.assert_allclose(got, to_carry(robot, q, assist), atol=1e-5)


def test_pushed_by_the_operator_the_feet_carry_the_push_too(
    robot: RobotConfig, ik: InverseKinematics, closed: Closed
) -> None:
    """Leant on until 2 mm off centre: sum of the feet = weight + assist + operator.

    The operator pushes on the torso with what K_fail and K_c answer along p.
    """
    assist, moved = 150.0, np.array([0.002, -0.002, 0.0, 0.002, 0.0, 0.002])
    centre = closed(1.1)
    law = Hocca(robot)
    settled(law, centre, assist)
    pushed = at_pose(robot, ik, oracle.pose(robot, centre) + moved, centre)
    for _ in range(2):  # the second tick's feedforward is that of the moved reference
        output = law.tick(pushed, STILL, assist, 0.0)
    T = oracle.feasible(robot, pushed)
    K_fail = law._split.certificate.failsafe_stiffness(output.local.D)
    K_c, _ = law._terms._uncoupled.at(K_fail, (T.T * output.local.D_B) @ T)
    along_p = (K_fail + K_c) @ moved
    torso_per_p = oracle.leg_jacobian(robot, RIGHT, pushed) @ T[oracle.LEG[RIGHT]]
    operator = np.linalg.solve(torso_per_p.T, along_p)
    push = about_origin(operator, oracle.leg(robot, RIGHT, pushed).torso)
    assert np.abs(operator[:2]).min() > 3.0
    got = on_the_feet(robot, pushed, torque(output, pushed)) - to_carry(robot, pushed, assist)
    np.testing.assert_allclose(got, -push, atol=0.02 * np.abs(push).max())


def test_each_centre_of_pressure_stays_inside_its_sole(
    robot: RobotConfig, ik: InverseKinematics, closed: Closed
) -> None:
    """Over the whole squat and the whole crawl, with 0 and 200 N; and no foot slides."""
    geometry = robot.geometry
    law, q, nearest = Hocca(robot), closed(1.188), np.inf
    for assist in (0.0, 200.0):
        for height, pitch in [*SQUAT, *SQUAT[::-1], *CRAWL]:
            q = at_pose(robot, ik, p_at(robot, height, pitch=pitch), q)
            for wrench in feet(robot, q, torque(settled(law, q, assist), q)):
                force = wrench[:3]
                below = np.array([0.0, 0.0, -geometry.foot_height])
                moment = wrench[3:] - np.cross(below, force)
                x, y = -moment[1] / force[2], moment[0] / force[2]
                room = (geometry.l_foot / 2 - abs(x), geometry.w_foot / 2 - abs(y))
                nearest = min(nearest, *room)
                assert min(room) > 0.0, (height, pitch, assist, x, y)
                assert force[2] > 0.3 * oracle.masses(robot)[1] * oracle.GRAVITY
                assert np.hypot(force[0], force[1]) < 0.5 * force[2]  # rubber on a poor floor
    print(f"nearest to an edge: {1e3 * nearest:.1f} mm")  # noqa: T201  # shown by pytest -rP
    assert nearest > 0.01


# -- the law, differentiated -----------------------------------------------------------


def K_p(robot: RobotConfig) -> Array:  # noqa: N802 - the paper's letter
    return np.diag(np.array(robot.law.K_p) * (1.0 - np.array(robot.law.S)))


@pytest.fixture
def exact_ik(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the inverse kinematics go on until nothing is left to do."""
    monkeypatch.setattr(inverse_kinematics, "TOLERANCE", 1e-13)
    for module in (inverse_kinematics, reference):
        monkeypatch.setattr(module, "STEP_SURE", 1e-9)


def with_law(robot: RobotConfig, **changes: object) -> RobotConfig:
    law = msgspec.structs.replace(robot.law, **changes)
    return msgspec.structs.replace(robot, law=law)


def torque_of(law: Hocca) -> Callable[[Array, Array], Array]:
    """Return (q, v) -> total torque (12,) of a tick at standing time, nothing remembered."""

    def total(q: Array, v: Array) -> Array:
        return torque(law.tick(q, v, 0.0, 0.0), q, v)

    return total


@pytest.mark.usefixtures("exact_ik")
def test_along_the_closed_chain_the_law_feels_like_k_p_or_more_where_it_balances_and_free_elsewhere(
    robot: RobotConfig, q: Array
) -> None:
    """With the real S, references moving: -dQ/dp = (K_fail + K_c) S_perp, Q all forces."""
    law = Hocca(robot)
    law.tick(q, STILL, 0.0, 0.0, align=True)
    total, q_of = torque_of(law), oracle.closed_chain(robot, q)

    def felt(p: Array) -> Array:
        q_near = q_of(p)
        out_of_balance = total(q_near, STILL) - weight_and_load(robot, q_near, 0.0)
        return np.asarray(oracle.feasible(robot, q_near).T @ out_of_balance, float)

    slope = oracle.derivative(felt, oracle.pose(robot, q), 1e-4)
    S_perp = np.diag(1.0 - np.array(robot.law.S))
    at_ref = law.tick(q, STILL, 0.0, 0.0)
    T, D = oracle.feasible(robot, q), at_ref.local.D
    # T_ref has them at the law's own damping of its inverse
    K_fail = law._split.certificate.failsafe_stiffness(D)
    K_c, _ = law._terms._uncoupled.at(K_fail, (T.T * at_ref.local.D_B) @ T)
    wanted = (K_fail + K_c) @ S_perp
    np.testing.assert_allclose(-slope, wanted, rtol=2e-3, atol=3.0)
    closed = np.flatnonzero(np.diag(S_perp))
    left = -slope[np.ix_(closed, closed)] - K_p(robot)[np.ix_(closed, closed)]
    assert np.linalg.eigvalsh(0.5 * (left + left.T)).min() > -3.0


@pytest.mark.usefixtures("exact_ik")
def test_along_the_closed_chain_motion_is_damped_where_it_balances_and_free_elsewhere(
    robot: RobotConfig, q: Array
) -> None:
    law = Hocca(robot)
    law.tick(q, STILL, 0.0, 0.0, align=True)
    total, T = torque_of(law), oracle.feasible(robot, q)
    slope = oracle.derivative(lambda pdot: T.T @ total(q, T @ pdot), np.zeros(6), 1e-4)
    S_perp = np.diag(1.0 - np.array(robot.law.S))
    local = law.tick(q, STILL, 0.0, 0.0).local
    B_local = (T.T * local.D_B) @ T
    _, B_c = law._terms._uncoupled.at(law._split.certificate.failsafe_stiffness(local.D), B_local)
    wanted = (B_local + B_c) @ S_perp
    np.testing.assert_allclose(-slope, wanted, rtol=2e-3, atol=0.5)
