"""Where easing and assist are stable, against loops simulated step by step."""

from __future__ import annotations

import math
from collections import deque

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from tools.lab.design.led_loop import LedLoop, alpha_max, integral_s_min

STEP_S = 2e-4


Z = LedLoop(mass=65.0, b_r=0.0, k_r=0.0, k=1500.0, b=20.0, delay_s=0.05, low_pass_hz=40.0)


LOOPS = [
    Z,
    msgspec.structs.replace(Z, b=150.0, delay_s=0.02),
    msgspec.structs.replace(Z, b=150.0, delay_s=0.06),
    msgspec.structs.replace(Z, k=10_000.0, b=100.0, delay_s=0.02),
    msgspec.structs.replace(Z, b_r=40.0, k_r=300.0),
    LedLoop(mass=5.0, b_r=1.0, k_r=0.0, k=200.0, b=5.0, delay_s=0.04, low_pass_hz=40.0),
]


def growth(loop: LedLoop, *, alpha: float = 0.0, integral_s: float = math.inf) -> float:
    """Return how much larger late swings are than early ones; the loop starts with a kick.

    Semi-implicit Euler on m dv = w - b_r v - k_r x + alpha w_late + integral.
    """
    x, v, filtered, integral = 0.0, 1.0, 0.0, 0.0
    late = deque([0.0] * round(loop.delay_s / STEP_S))
    weight = STEP_S * 2.0 * math.pi * loop.low_pass_hz
    sizes = []
    for _ in range(round(60.0 / STEP_S)):
        w = -loop.k * x - loop.b * v
        filtered += weight * (w - filtered)
        late.append(filtered)
        w_late = late.popleft()
        # measured is what the robot gives the operator: -w
        integral += STEP_S * w_late / integral_s
        force = w - loop.b_r * v - loop.k_r * x + alpha * w_late + integral
        v += STEP_S * force / loop.mass
        x += STEP_S * v
        sizes.append(abs(v))
        if abs(v) > 1e6:
            return math.inf
    third = len(sizes) // 3
    return max(sizes[2 * third :]) / max(sizes[third : 2 * third])


@pytest.mark.parametrize("loop", LOOPS)
def test_the_eased_lead_is_stable_below_alpha_max_and_unstable_above(loop: LedLoop) -> None:
    limit = alpha_max(loop)
    assert growth(loop, alpha=0.9 * limit) < 0.9
    assert growth(loop, alpha=1.1 * limit) > 1.1


@pytest.mark.parametrize("loop", LOOPS)
def test_the_integral_is_stable_above_its_least_time_and_unstable_below(loop: LedLoop) -> None:
    least = integral_s_min(loop)
    assert growth(loop, integral_s=1.1 * least) < 0.95
    assert growth(loop, integral_s=0.9 * least) > 1.05


@pytest.mark.parametrize(("k", "b"), [(1500.0, 150.0), (1500.0, 50.0), (800.0, 60.0)])
def test_the_integral_without_delay_has_the_limit_of_routh(k: float, b: float) -> None:
    loop = msgspec.structs.replace(Z, k=k, b=b, delay_s=0.0, low_pass_hz=1e5)
    assert integral_s_min(loop) == pytest.approx(loop.mass / b - b / k, rel=0.01)


def test_later_is_less_stable() -> None:
    limits = [alpha_max(msgspec.structs.replace(Z, delay_s=ms / 1e3)) for ms in (5, 10, 20, 40)]
    assert limits == sorted(limits, reverse=True)


def test_an_undelayed_lead_may_be_eased_as_much_as_one_likes() -> None:
    assert alpha_max(msgspec.structs.replace(Z, delay_s=0.0)) == math.inf


def test_the_simulated_hand_leaves_room_at_20_ms_one_way(robot: RobotConfig) -> None:
    hand = msgspec.structs.replace(Z, mass=70.0, b=150.0, delay_s=0.048)
    assert alpha_max(hand) > 5.0
    assert integral_s_min(hand) < robot.assist.integral_s / 5.0
