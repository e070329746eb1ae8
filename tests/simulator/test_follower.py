"""A hand that is led from outside follows without a jump."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from services.simulator.physics.follower import BANDWIDTH, Follower

RATE_MAX = 0.5
PLACES = st.floats(-10.0, 10.0)


@given(st.lists(st.tuples(PLACES, st.floats(1e-4, 2.0)), max_size=30))
def test_it_never_moves_faster_than_its_limit_whatever_is_asked_for(
    asked: list[tuple[float, float]],
) -> None:
    follower = Follower(0.0, RATE_MAX)
    for wanted, dt in asked:
        before = follower.at
        follower.advance(wanted, dt)
        assert abs(follower.at - before) <= RATE_MAX * dt + 1e-9
        assert abs(follower.rate) <= RATE_MAX + 1e-9
        assert math.isfinite(follower.at)


@given(PLACES, st.integers(1, 20))
def test_it_arrives_without_overshoot_and_rests(wanted: float, steps_per_10_ms: int) -> None:
    follower, dt = Follower(0.0, RATE_MAX), 0.01 / steps_per_10_ms
    for _ in range(round((abs(wanted) / RATE_MAX + 20.0 / BANDWIDTH) / dt)):
        follower.advance(wanted, dt)
        assert abs(follower.at) <= abs(wanted) + 1e-3
    assert abs(follower.at - wanted) < 1e-3
    assert abs(follower.rate) < 1e-2


def test_within_its_limit_it_is_the_critically_damped_solution() -> None:
    follower, dt, wanted = Follower(0.0, RATE_MAX), 1e-3, 0.01
    for step in range(1, 1000):
        follower.advance(wanted, dt)
        w_t = BANDWIDTH * step * dt
        assert abs(follower.at - wanted * (1.0 - (1.0 + w_t) * math.exp(-w_t))) < 1e-9
