"""Dense sweeps of the last step before the drive, to each boundary and beyond it."""

from __future__ import annotations

import math
from itertools import product

import pytest

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
