from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.torque_limiter import TorqueLimits, limit_differential, limit_torque, limits_of
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig

MAX = 115.6
STEP = 40.0
K_STOP = 400.0
LIMITS = TorqueLimits(
    phi=(-0.6, 0.6), theta=(-3.0, -0.2), soft_stop_k_p=K_STOP, tau_module_max=MAX, tau_step_max=STEP
)
FREE: Pair = (0.0, -1.0)
"""A pose away from every stop."""

torques = st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))
sent = torques.map(lambda tau: limit_differential(tau, MAX))
"""What can have gone out in the last cycle."""


@given(tau=torques)
def test_torque_within_all_limits_goes_out_as_it_came(tau: Pair) -> None:
    inside = (tau[0] / 300.0 * MAX / 2.01, tau[1] / 300.0 * MAX / 2.01)
    assert limit_torque(inside, FREE, inside, LIMITS) == pytest.approx(inside, abs=1e-12)


@given(tau=torques, last=sent)
def test_no_axis_gets_more_than_was_asked_or_went_out_before(tau: Pair, last: Pair) -> None:
    out = limit_torque(tau, FREE, last, LIMITS)
    for axis in (0, 1):
        low, high = min(0.0, tau[axis], last[axis]), max(0.0, tau[axis], last[axis])
        assert low - 1e-9 <= out[axis] <= high + 1e-9


@given(tau=torques)
def test_diamond_reduces_each_axis_and_turns_no_sign(tau: Pair) -> None:
    for got, asked in zip(limit_differential(tau, MAX), tau, strict=True):
        assert abs(got) <= abs(asked) + 1e-9
        assert got * asked >= -1e-9


@given(tau=torques)
def test_diamond_clips_each_motor_by_itself(tau: Pair) -> None:
    to_motors = np.array([[1.0, 1.0], [-1.0, 1.0]])  # times 1 / 2N
    expected = np.clip(to_motors @ tau, -MAX, MAX)
    np.testing.assert_allclose(to_motors @ limit_differential(tau, MAX), expected, atol=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_torque_that_is_no_number_changes_nothing(bad: float, axis: int) -> None:
    tau = (bad, 1.0) if axis == 0 else (1.0, bad)
    assert limit_torque(tau, FREE, (10.0, -20.0), LIMITS) == (10.0, -20.0)


@pytest.mark.parametrize("beyond", [1e-6, 0.01, 0.09])
@pytest.mark.parametrize(
    ("axis", "stop", "outwards"), [(0, -0.6, -1), (0, 0.6, 1), (1, -3.0, -1), (1, -0.2, 1)]
)
def test_soft_stop_is_a_spring_that_pushes_inwards(
    axis: int, stop: float, outwards: int, beyond: float
) -> None:
    q = [*FREE]
    q[axis] = stop + outwards * beyond
    out = limit_torque((0.0, 0.0), (q[0], q[1]), (0.0, 0.0), LIMITS)
    assert out[axis] == pytest.approx(-outwards * K_STOP * beyond)
    assert out[1 - axis] == 0.0


@pytest.mark.parametrize("q", [(-0.6, -1.0), (0.6, -1.0), (0.0, -3.0), (0.0, -0.2), (0.6, -0.2)])
def test_soft_stop_does_nothing_at_the_stop_itself(q: Pair) -> None:
    assert limit_torque((0.0, 0.0), q, (0.0, 0.0), LIMITS) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("module", "theta"), [("ankle_left", (-0.6, 0.9)), ("knee_right", (-3.0, -0.2))]
)
def test_limits_are_those_of_its_kind(robot: RobotConfig, module: str, theta: Pair) -> None:
    limits = limits_of(robot, module)
    assert limits.theta == theta
    assert limits.tau_module_max == MAX
    assert limits.tau_step_max == pytest.approx(20_000.0 / 500.0)
