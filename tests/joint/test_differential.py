from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.differential import (
    joint_from_motor,
    joint_torque,
    motor_from_joint,
    motor_torque,
)
from shared.bus.messages import Pair

gear_ratios = st.floats(1.0, 200.0)
pairs = st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))


@given(joint=pairs, n=gear_ratios)
def test_angles_come_back_from_the_motors(joint: Pair, n: float) -> None:
    np.testing.assert_allclose(joint_from_motor(motor_from_joint(joint, n), n), joint, atol=1e-9)


@given(tau=pairs, n=gear_ratios)
def test_torques_come_back_from_the_motors(tau: Pair, n: float) -> None:
    np.testing.assert_allclose(joint_torque(motor_torque(tau, n), n), tau, atol=1e-9)


@given(tau=pairs, v=pairs, n=gear_ratios)
def test_power_is_the_same_on_both_sides(tau: Pair, v: Pair, n: float) -> None:
    motor_rates = 2.0 * math.pi * np.array(motor_from_joint(v, n))  # rad/s
    at_motors = np.array(motor_torque(tau, n)) @ motor_rates
    assert at_motors == pytest.approx(np.array(tau) @ np.array(v), rel=1e-9, abs=1e-6)


@given(tau=pairs, n=gear_ratios)
def test_the_harder_worked_motor_carries_the_sum_of_both_torques(tau: Pair, n: float) -> None:
    harder = max(abs(torque) for torque in motor_torque(tau, n))
    assert 2.0 * n * harder == pytest.approx(abs(tau[0]) + abs(tau[1]), rel=1e-12, abs=1e-12)


def test_first_motor_turns_both_axes_forward_and_the_second_turns_phi_back() -> None:
    turn = math.pi / 17.5  # rad at the joint: one motor turn, through the gear, halved
    assert joint_from_motor((1.0, 0.0), 17.5) == pytest.approx((turn, turn))
    assert joint_from_motor((0.0, 1.0), 17.5) == pytest.approx((-turn, turn))
