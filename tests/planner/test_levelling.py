from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from services.planner.hocca import Hocca
from services.planner.levelling import SLOPE_MAX, Levelling, slope_of
from shared.config import GRAVITY, RobotConfig
from shared.messages import Vector3
from tests.imu.robots import with_imu
from tests.planner import oracle
from tests.planner.conftest import Closed

LEVEL = np.zeros(3)
DT = 0.004
slopes = st.tuples(*[st.floats(-0.14, 0.14)] * 2)


def up_of(slope: tuple[float, float], angles: tuple[float, float, float]) -> Vector3:
    """Return what an IMU tells on a floor with this slope, the torso so turned on the floor."""
    x, y = math.sin(slope[0]), math.sin(slope[1])
    up = np.array((x, y, math.sqrt(1.0 - x * x - y * y)))
    roll, pitch, yaw = angles
    a, b, c = Rotation.from_euler("ZXY", (yaw, roll, pitch)).inv().apply(up).tolist()
    return a, b, c


@given(slopes, st.tuples(st.floats(-0.3, 0.3), st.floats(-0.5, 1.3), st.floats(-0.3, 0.3)))
def test_the_slope_is_found_however_the_torso_stands(
    slope: tuple[float, float], angles: tuple[float, float, float]
) -> None:
    """By scipy's rotations."""
    assert slope_of(up_of(slope, angles), *angles) == pytest.approx(slope, abs=1e-12)


def test_a_slope_that_nobody_stands_on_is_bounded() -> None:
    assert slope_of((1.0, 0.0, 0.0), 0.0, 0.0, 0.0) == pytest.approx((SLOPE_MAX, 0.0))
    assert slope_of((0.0, -1.0, 0.0), 0.0, 0.0, 0.0) == pytest.approx((0.0, -SLOPE_MAX))


def test_the_first_word_of_the_imu_is_believed_at_once_and_later_ones_slowly() -> None:
    levelling = Levelling(1.0)
    levelling.advance(up_of((0.05, -0.02), (0.0, 0.0, 0.0)), LEVEL, DT)
    assert levelling.slope == pytest.approx((0.05, -0.02))
    for _ in range(round(1.0 / DT)):
        levelling.advance(up_of((0.0, 0.0), (0.0, 0.0, 0.0)), LEVEL, DT)
    assert levelling.slope == pytest.approx((0.05 / math.e, -0.02 / math.e))
    assert levelling.up == pytest.approx(
        (math.sin(levelling.slope[0]), math.sin(levelling.slope[1]), 1.0), abs=1e-3
    )


def test_without_the_imu_the_last_slope_stands_and_with_none_ever_the_floor_is_level() -> None:
    levelling = Levelling(1.0)
    levelling.advance(None, LEVEL, DT)
    assert levelling.slope == (0.0, 0.0)
    levelling.advance(up_of((0.05, 0.0), (0.0, 0.0, 0.0)), LEVEL, DT)
    for _ in range(1000):
        levelling.advance(None, LEVEL, DT)
    assert levelling.slope == pytest.approx((0.05, 0.0))


def test_a_memory_goes_on_bit_for_bit() -> None:
    first, second = Levelling(1.0), Levelling(1.0)
    first.advance(up_of((0.05, 0.01), (0.0, 0.0, 0.0)), LEVEL, DT)
    second.recall(first.remember())
    for each in (first, second):
        each.advance(up_of((0.02, 0.0), (0.1, 0.2, 0.0)), np.array((0.1, 0.2, 0.0)), DT)
    assert first.slope == second.slope
    assert np.array_equal(first.up, second.up)


FLOORS = [(0.0873, 0.0), (-0.0873, 0.0), (0.0, 0.0873), (0.05, -0.05)]


@pytest.mark.parametrize("slope", FLOORS)
@pytest.mark.parametrize(("height", "pitch"), [(1.188, 0.0), (0.948, 0.0), (0.85, 0.6)])
def test_on_a_slope_feedforward_holds_the_weight_along_every_closed_motion(
    robot: RobotConfig, closed: Closed, slope: tuple[float, float], height: float, pitch: float
) -> None:
    """Virtual work against the oracle's COM: the weight pulls along the slope too."""
    law, q = Hocca(with_imu(robot)), closed(height, pitch=pitch)
    up_torso = up_of(slope, tuple(oracle.pose(robot, q)[3:]))
    output = law.tick(q, np.zeros(12), 0.0, DT, align=True, up_torso=up_torso)
    assert output.slope == pytest.approx(slope)
    x, y = np.sin(slope)
    up = np.array((x, y, math.sqrt(1.0 - x * x - y * y)))
    weight = robot.total_mass * GRAVITY
    com = oracle.derivative(lambda angles: oracle.pose(robot, angles)[:3], q, 1e-5)
    C = oracle.derivative(lambda angles: oracle.closure(robot, angles), q)
    closed_motions = np.linalg.svd(C)[2][6:]
    np.testing.assert_allclose(
        closed_motions @ output.tau_ff, closed_motions @ (weight * up @ com), atol=1e-4
    )


@pytest.mark.parametrize("slope", FLOORS)
def test_the_com_is_led_to_where_gravity_puts_it_over_the_ankles(
    robot: RobotConfig, closed: Closed, slope: tuple[float, float]
) -> None:
    law, q = Hocca(with_imu(robot)), closed(1.0)
    up_torso = up_of(slope, (0.0, 0.0, 0.0))
    first = law.tick(q, np.zeros(12), 0.0, DT, align=True, up_torso=up_torso)
    np.testing.assert_allclose(first.p_ref, first.p, atol=1e-7)
    for _ in range(round(robot.law.recentre_s / DT) + 1):
        output = law.tick(q, np.zeros(12), 0.0, DT, up_torso=up_torso)
    lean = np.sin(slope) / law._levelling.up[2]
    np.testing.assert_allclose(output.p_ref[:2], lean * output.p[2], atol=1e-7)
    assert np.abs(output.p_ref[3:6:2]).max() < 1e-7
