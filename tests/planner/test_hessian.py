"""sum_i H_i F_i against second differences of the oracle's closed chain."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from shared.config.robot_config import RobotConfig
from tests.planner import oracle
from tests.planner.conftest import Closed
from tests.planner.oracle import Array

POSES = (
    {"height": 1.188},
    {"height": 1.0, "pitch": 0.5, "x": 0.03, "y": -0.02, "roll": 0.06, "yaw": 0.08},
    {"height": 0.85, "pitch": 1.0, "x": -0.03, "y": 0.04, "roll": -0.05, "yaw": -0.05},
    {"height": 0.80, "pitch": 1.2, "x": 0.01, "y": 0.01, "roll": 0.03, "yaw": -0.03},
)
WEIGHT = np.array([0.0, 0.0, 731.6, 0.0, 0.0, 0.0])
NO_FORCE = np.zeros(3)
STEP = 1e-4
"""m and rad; of the second differences."""


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


@pytest.fixture(params=POSES, ids=lambda p: f"{p['height']:g}m-{p.get('pitch', 0):g}rad")
def q(request: pytest.FixtureRequest, closed: Closed) -> Array:
    return closed(**request.param)


@pytest.mark.parametrize("mixed", ["load_sharing", "average"])
def test_hessian_is_exact_along_the_closed_chain(
    robot: RobotConfig, kinematics: Kinematics, averaging: Kinematics, q: Array, mixed: str
) -> None:
    """T^T H T is the curvature by p of F_h . r_harness - tau . q(p), tau = J^T F + J_h^T F_h held.

    F . p itself does not curve. All kinds of load are told apart, to 5e-5 of the largest.
    """
    model = kinematics if mixed == "load_sharing" else averaging
    model.update(q)
    held = np.array([w.F @ model.J + w.F_harness @ model.J_harness for w in LOADS.values()])
    forces = np.array([w.F_harness for w in LOADS.values()])
    hessians = {name: model.hessian_times(*load).copy() for name, load in LOADS.items()}
    q_of, p = oracle.closed_chain(robot, q), oracle.pose(robot, q)

    def energy(p_near: Array) -> Array:
        q_near = q_of(p_near)
        return np.asarray(forces @ oracle.harness(robot, q_near) - held @ q_near, float)

    curvature = oracle.second_derivative(energy, p, STEP)
    T = oracle.feasible(robot, q)
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


def test_hessian_is_linear_in_the_load(kinematics: Kinematics, q: Array) -> None:
    kinematics.update(q)
    one, other = LOADS["all"], LOADS["yaw"]
    parts = [2.0 * kinematics.hessian_times(*one).copy(), kinematics.hessian_times(*other).copy()]
    whole = kinematics.hessian_times(2.0 * one.F + other.F, 2.0 * one.F_harness)
    np.testing.assert_allclose(whole, sum(parts), atol=1e-9)


def torque_slope(kinematics: Kinematics, q: Array, F: Array) -> Array:
    """Return d(J^T F)/dq (12, 12) by differences, the shares held."""
    kinematics.update(q)
    D_left = kinematics.D_left.copy()

    def torque(q_near: Array) -> Array:
        kinematics.update(q_near, D_left)
        return np.asarray(kinematics.J.T @ F, float)

    return oracle.derivative(torque, q)


@pytest.mark.parametrize("force", [(0, 0, 731.6), (50, 0, 0), (0, 50, 0), (30, -20, 731)])
def test_hessian_of_a_force_is_the_slopes_symmetric_part(
    kinematics: Kinematics, q: Array, force: tuple[float, float, float]
) -> None:
    """Off the closed chain too, where the legs are pulled apart."""
    F = np.array([*force, 0.0, 0.0, 0.0])
    want = torque_slope(kinematics, q, F)
    kinematics.update(q)
    hessian = kinematics.hessian_times(F, NO_FORCE)
    np.testing.assert_allclose(hessian, 0.5 * (want + want.T), atol=1e-5)


def test_holding_the_shares_changes_internal_torques_only(
    robot: RobotConfig, kinematics: Kinematics, q: Array
) -> None:
    """The slope with the shares let free differs a lot, but not along what the robot can do."""

    def torque(q_near: Array) -> Array:
        kinematics.update(q_near)
        return np.asarray(kinematics.J.T @ WEIGHT, float)

    free = oracle.derivative(torque, q)
    error = free - torque_slope(kinematics, q, WEIGHT)
    T = oracle.feasible(robot, q)
    assert np.abs(error).max() > 10.0
    np.testing.assert_allclose(T.T @ error @ T, 0.0, atol=1e-3)
