""""""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from services.planner.law.feet import SLOPE_MAX, Levelling, LevellingState, slope_of, up_of
from shared.bus.messages import Pair, Vector3
from shared.config.robot_config import GRAVITY
from tests.imu.robots import with_imu
from tests.planner import oracle
from tests.planner.states import DT, ROBOT, Kept, Law, closed
from tools.lab.design.torque_breakdown import torque_breakdown

LEVEL = np.zeros(3)
slopes = st.tuples(*[st.floats(-0.14, 0.14)] * 2)


def told(slope: Pair, angles: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Vector3:
    """Return what an IMU tells on a floor with this slope, the torso so turned on the floor."""
    roll, pitch, yaw = angles
    turned_back = Rotation.from_euler("ZXY", (yaw, roll, pitch)).inv()
    a, b, c = turned_back.apply(up_of(slope)).tolist()
    return a, b, c


@given(slopes, st.tuples(st.floats(-0.3, 0.3), st.floats(-0.5, 1.3), st.floats(-0.3, 0.3)))
def test_the_slope_is_found_however_the_torso_stands(
    slope: tuple[float, float], angles: tuple[float, float, float]
) -> None:
    """By scipy's rotations."""
    assert slope_of(told(slope, angles), *angles) == pytest.approx(slope, abs=1e-12)


@pytest.mark.parametrize(
    "up",
    [
        (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (math.sin(SLOPE_MAX + 0.01), 0.0, 0.9),
        None,
    ],
)  # fmt: skip
def test_what_no_floor_is_like_is_left_out_and_the_last_slope_stands(up: Vector3 | None) -> None:
    """An IMU that has come loose, is upside down, or is silent; with none ever it is level."""
    levelling = Kept(Levelling(1.0), LevellingState())
    levelling.advance(up, LEVEL, DT, jump=True)
    assert levelling.state.slope == (0.0, 0.0)
    levelling.advance(told((0.05, 0.0)), LEVEL, DT, jump=True)
    for _ in range(1000):
        levelling.advance(up, LEVEL, DT, jump=True)
    assert levelling.state.slope == pytest.approx((0.05, 0.0))


def test_the_first_attitude_is_taken_as_it_is_while_the_robot_is_not_led() -> None:
    levelling = Kept(Levelling(1.0), LevellingState())
    levelling.advance(told((0.05, -0.02)), LEVEL, DT, jump=True)
    assert levelling.state.slope == pytest.approx((0.05, -0.02))
    for _ in range(round(1.0 / DT)):
        levelling.advance(told((0.0, 0.0)), LEVEL, DT, jump=True)
    assert levelling.state.slope == pytest.approx((0.05 / math.e, -0.02 / math.e))
    assert up_of(levelling.state.slope) == pytest.approx(up_of(levelling.state.slope))


FLOORS = [(0.0873, 0.0), (-0.0873, 0.0), (0.0, 0.0873), (0.05, -0.05)]


@pytest.mark.parametrize("slope", FLOORS)
@pytest.mark.parametrize(("height", "pitch"), [(1.188, 0.0), (0.948, 0.0), (0.85, 0.6)])
def test_on_a_slope_feedforward_holds_the_weight_along_every_closed_motion(
    slope: tuple[float, float], height: float, pitch: float
) -> None:
    """Virtual work against the oracle's COM: the weight pulls along the slope too."""
    law, q = Law(with_imu(ROBOT)), closed(height, pitch=pitch)
    up_torso = told(slope, tuple(oracle.pose(ROBOT, q)[3:]))
    output = law.align(q, up_torso=up_torso)
    assert output.slope == pytest.approx(slope)
    up = np.array(up_of(slope))
    weight = ROBOT.total_mass * GRAVITY
    com = oracle.derivative(lambda angles: oracle.pose(ROBOT, angles)[:3], q, 1e-5)
    C = oracle.derivative(lambda angles: oracle.closure(ROBOT, angles), q)
    closed_motions = np.linalg.svd(C)[2][6:]
    np.testing.assert_allclose(
        closed_motions @ output.tau_ff, closed_motions @ (weight * up @ com), atol=1e-4
    )


def test_a_tick_is_laid_open_with_its_slope() -> None:
    law, q, still = Law(with_imu(ROBOT)), closed(1.0), np.zeros(12)
    output = law.align(q, still, 0.0, DT, up_torso=told((0.0873, -0.03)))
    found = torque_breakdown(ROBOT, q, still, output.q_ref, output.v_ref, 0.0, output.slope)
    np.testing.assert_allclose(found.gravity, output.tau_ff, atol=1e-6)


@pytest.mark.parametrize("slope", FLOORS)
def test_the_com_is_led_to_where_gravity_puts_it_over_the_ankles(
    slope: tuple[float, float],
) -> None:
    law, q = Law(with_imu(ROBOT)), closed(1.0)
    up_torso = told(slope)
    first = law.align(q, up_torso=up_torso)
    np.testing.assert_allclose(first.p_ref, first.p, atol=1e-7)
    for _ in range(round(ROBOT.law.recentre_s / DT) + 1):
        output = law.tick(q, up_torso=up_torso)
    x, y, z = up_of(slope)
    lean = np.array((x, y)) / z
    np.testing.assert_allclose(output.p_ref[:2], lean * output.p[2], atol=1e-7)
    assert np.abs(output.p_ref[3:6:2]).max() < 1e-7


def test_an_imu_that_joins_a_led_robot_makes_no_step() -> None:
    """Taken at once, 5 degrees moved the ankles' reference by 0.08 rad in one tick: 125 N m."""
    law, q = Law(with_imu(ROBOT)), closed(1.0)
    law.align(q)
    before = law.tick(q)
    largest = 0.0
    for _ in range(500):
        output = law.tick(q, up_torso=told((0.0873, 0.0)))
        largest = max(largest, float(np.abs(output.q_ref - before.q_ref).max()))
        before = output
    assert output.slope[0] > 0.05
    assert largest < 1e-3
