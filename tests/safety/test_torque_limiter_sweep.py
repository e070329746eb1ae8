"""The last step before the drive: dense sweeps to each boundary and beyond it, and its algebra."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.differential import TorqueLimits, limit_differential, limit_torque, limits_of
from shared.bus.messages import Pair
from shared.joints import KINDS
from tests.robots import ROBOT

ROUNDING = 1e-9
HUGE = 1.7e308


@pytest.fixture(params=KINDS)
def limits(request: pytest.FixtureRequest) -> TorqueLimits:
    return limits_of(ROBOT, f"{request.param}_left")


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
        tau = (500.0 * math.cos(0.01 * cycle), 500.0 * math.sin(0.01 * cycle))
        out = limit_torque(tau, (0.0, -0.5), out, limits)
        assert abs(out[0]) + abs(out[1]) <= limits.tau_module_max + ROUNDING


def test_soft_stop_pushes_only_inwards_and_only_beyond_the_stop(limits: TorqueLimits) -> None:
    """As a spring, on its own axis only."""
    offsets = [step * 1e-4 for step in range(-300, 301)]
    offsets += [sign * 10.0**-power for sign in (-1, 1) for power in range(5, 13)]
    for axis, (low, high) in enumerate((limits.phi, limits.theta)):
        for offset, stop in product(offsets, (low, high)):
            angle = stop + offset
            q = (angle, -0.5) if axis == 0 else (0.0, angle)
            push = limit_torque((0.0, 0.0), q, (0.0, 0.0), limits)
            beyond = min(0.0, angle - low) + max(0.0, angle - high)
            assert push[axis] == pytest.approx(-limits.soft_stop_k_p * beyond, rel=1e-9)
            assert push[1 - axis] == 0.0


# ---- its algebra

MAX = 115.6
LIMITS = TorqueLimits(
    phi=(-0.6, 0.6), theta=(-3.0, -0.2), soft_stop_k_p=400.0, tau_module_max=MAX, tau_step_max=40.0
)
FREE: Pair = (0.0, -1.0)
"""A pose away from every stop."""
torques = st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))
sent = torques.map(lambda tau: limit_differential(tau, MAX))
"""What can have gone out in the last cycle."""


@given(tau=torques, last=sent)
def test_no_axis_gets_more_than_was_asked_or_went_out_before_and_what_is_inside_stays(
    tau: Pair, last: Pair
) -> None:
    out = limit_torque(tau, FREE, last, LIMITS)
    for axis in (0, 1):
        low, high = min(0.0, tau[axis], last[axis]), max(0.0, tau[axis], last[axis])
        assert low - 1e-9 <= out[axis] <= high + 1e-9
    inside = (tau[0] / 300.0 * MAX / 2.01, tau[1] / 300.0 * MAX / 2.01)
    assert limit_torque(inside, FREE, inside, LIMITS) == pytest.approx(inside, abs=1e-12)


@given(tau=torques, size=st.sampled_from([1.0, 1e3, HUGE / 600.0]))
def test_diamond_clips_each_motor_by_itself(tau: Pair, size: float) -> None:
    """So that no motor gets more than its share, and no axis more than asked or another sign."""
    to_motors = np.array([[1.0, 1.0], [-1.0, 1.0]])  # times 1 / 2N
    asked = (size * tau[0], size * tau[1])
    expected = np.clip(to_motors @ asked, -MAX, MAX)
    np.testing.assert_allclose(to_motors @ limit_differential(asked, MAX), expected, atol=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_torque_that_is_no_number_changes_nothing(bad: float, axis: int) -> None:
    tau = (bad, 1.0) if axis == 0 else (1.0, bad)
    assert limit_torque(tau, FREE, (10.0, -20.0), LIMITS) == (10.0, -20.0)


@pytest.mark.parametrize(
    ("module", "theta"), [("ankle_left", (-0.6, 0.9)), ("knee_right", (-3.0, -0.2))]
)
def test_limits_are_those_of_its_kind(module: str, theta: Pair) -> None:
    limits = limits_of(ROBOT, module)
    assert (limits.theta, limits.tau_module_max) == (theta, MAX)
    assert limits.tau_step_max == pytest.approx(20_000.0 / 500.0)
