"""The last step before the drive: dense sweeps to each boundary and beyond it, and its algebra."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.torque_limiter import TorqueLimits, limit_differential, limit_torque, limits_of
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.joints import KINDS

ROUNDING = 1e-9

HUGE = 1.7e308


@pytest.fixture(params=KINDS)
def limits(request: pytest.FixtureRequest, robot: RobotConfig) -> TorqueLimits:
    return limits_of(robot, f"{request.param}_left")


def around(value: float) -> tuple[float, ...]:
    """Return a boundary, its two neighbours among the floats, and points farther off."""
    below, above = math.nextafter(value, -math.inf), math.nextafter(value, math.inf)
    return (value - 0.01, below, value, above, value + 0.01)


def wanted_torques(limits: TorqueLimits) -> list[float]:
    boundaries = (limits.tau_module_max / 2.0, limits.tau_module_max, limits.tau_step_max)
    near = [tau for b in boundaries for tau in (*around(b), *around(-b))]
    return [0.0, *near, 1e3, -1e3, HUGE, -HUGE, math.inf, -math.inf, math.nan]


def poses(limits: TorqueLimits) -> list[Pair]:
    phis = [0.0, *around(limits.phi[0]), *around(limits.phi[1]), 50.0, math.nan, math.inf]
    thetas = [-0.5, *around(limits.theta[0]), *around(limits.theta[1]), -HUGE, math.nan]
    return [(phi, -0.5) for phi in phis] + [(0.0, theta) for theta in thetas]


def corners_and_inside(limits: TorqueLimits) -> list[Pair]:
    top, half = limits.tau_module_max, limits.tau_module_max / 2.0
    return [(0.0, 0.0), (top, 0.0), (-top, 0.0), (0.0, top), (0.0, -top), (half, -half), (3, -7)]


def test_the_limiter_passes_the_diamond_and_its_step_at_most(limits: TorqueLimits) -> None:
    torques = wanted_torques(limits)
    worst_sum = worst_step = 0.0
    for phi, theta, last in product(torques, torques, corners_and_inside(limits)):
        for q in poses(limits)[:: 1 if phi == 0.0 else 5]:
            out = limit_torque((phi, theta), q, last, limits)
            assert math.isfinite(out[0])
            assert math.isfinite(out[1])
            worst_sum = max(worst_sum, abs(out[0]) + abs(out[1]))
            worst_step = max(worst_step, abs(out[0] - last[0]), abs(out[1] - last[1]))
    # reached and not passed: the sweep did come up to both boundaries
    assert worst_sum == pytest.approx(limits.tau_module_max, abs=ROUNDING)
    assert worst_step == pytest.approx(limits.tau_step_max, abs=ROUNDING)


def test_gate_held_against_the_diamond_never_creeps_out_of_it(limits: TorqueLimits) -> None:
    out: Pair = (0.0, 0.0)
    for cycle in range(20_000):
        angle = 0.01 * cycle
        out = limit_torque(
            (500.0 * math.cos(angle), 500.0 * math.sin(angle)), (0.0, -0.5), out, limits
        )
        assert abs(out[0]) + abs(out[1]) <= limits.tau_module_max + ROUNDING


def test_no_motor_gets_more_than_its_share_at_any_angle_in_the_plane() -> None:
    for degree in range(360):
        for size in (1.0, 115.5, 115.6, 115.7, 163.5, 1e6, HUGE):
            tau = (size * math.cos(math.radians(degree)), size * math.sin(math.radians(degree)))
            phi, theta = limit_differential(tau, 115.6)
            assert abs(theta + phi) <= 115.6 + ROUNDING
            assert abs(theta - phi) <= 115.6 + ROUNDING


def test_soft_stop_pushes_only_inwards_and_only_beyond_the_stop(limits: TorqueLimits) -> None:
    beyond_count = 0
    for axis, (low, high) in enumerate((limits.phi, limits.theta)):
        tiny = [sign * 10.0**-power for sign in (-1, 1) for power in range(5, 13)]
        for offset in (*(step * 1e-4 for step in range(-300, 301)), *tiny):
            for stop in (low, high):
                angle = stop + offset
                q = (angle, -0.5) if axis == 0 else (0.0, angle)
                push = limit_torque((0.0, 0.0), q, (0.0, 0.0), limits)[axis]
                if angle < low:
                    assert push > 0.0
                elif angle > high:
                    assert push < 0.0
                else:
                    assert push == 0.0
                beyond_count += push != 0.0
    assert beyond_count == 2 * 2 * (300 + 8)


# ---- its algebra

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
