"""The hand that somebody leads: it goes where it is asked to, gently and within limits."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.physics import led_hand
from services.simulator.physics.led_hand import BANDWIDTH, LedHand, follow
from shared.bus.messages import HandLead
from shared.config.scenarios import Lead

DT = 0.001
NOW = Lead(1.1, -0.05, 0.1, 0.02, 30.0)
NUMBER = st.floats(allow_nan=True, allow_infinity=True)


def asked(**fields: object) -> HandLead:
    rest = {"t_ns": 1, "seq": 1, "leads": True, "height": 0.0, "pitch": 0.0, "push": (0, 0, 0)}
    return msgspec.convert(rest | fields, HandLead)


@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=20))
def test_it_never_jumps_and_never_leaves_its_limits(places: list[tuple[float, float]]) -> None:
    hand = LedHand()
    hand.ask(asked(height=NOW.height, pitch=NOW.pitch), NOW)
    before = hand.over(NOW)
    assert before[:4] == NOW[:4], "it begins where the hand is"
    for height, pitch in places:
        hand.ask(asked(height=height, pitch=pitch), NOW)
        for _ in range(20):
            hand.advance(DT)
            now = hand.over(NOW)
            assert abs(now.height - before.height) <= led_hand.HEIGHT_MAX_RATE * DT + 1e-12
            assert abs(now.pitch - before.pitch) <= led_hand.PITCH_MAX_RATE * DT + 1e-12
            before = now
    for _ in range(400):
        hand.advance(50 * DT)
    low, high = led_hand.HEIGHTS
    assert low - 1e-6 <= hand.over(NOW).height <= high + 1e-6
    assert hand.over(NOW).assist == NOW.assist, "the assist stays the scenario's"


def test_it_stays_where_it_was_led_when_nobody_asks_any_more() -> None:
    hand = LedHand()
    hand.ask(asked(height=0.95, pitch=0.3), NOW)
    for _ in range(5000):
        hand.advance(DT)
    assert hand.over(NOW).height == pytest.approx(0.95, abs=1e-4)
    assert hand.over(NOW).pitch == pytest.approx(0.3, abs=1e-4)


def test_who_only_pushes_leaves_the_scenarios_path_alone_and_the_push_ends_by_itself() -> None:
    hand = LedHand()
    hand.ask(asked(leads=False, push=(0.0, 1e6, -3.0)), NOW)
    assert hand.push == (0.0, led_hand.PUSH_MAX, -3.0)
    assert hand.over(NOW) == NOW
    for _ in range(math.ceil(led_hand.PUSH_EXPIRES_S / DT) + 1):
        hand.advance(DT)
    assert hand.push is None


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["height", "pitch", "push"])
def test_what_is_no_number_is_ignored(field: str, wrong: float) -> None:
    hand = LedHand()
    hand.ask(asked(height=1.0, pitch=0.0, push=(1.0, 0.0, 0.0)), NOW)
    before = hand.numbers()
    given = (wrong, 0.0, 0.0) if field == "push" else wrong
    hand.ask(asked(**{"height": 0.9, "pitch": 0.5, field: given}), NOW)
    assert hand.numbers() == before


@given(st.booleans(), st.floats(0.7, 1.3), st.floats(-1, 1), st.integers(0, 400))
def test_a_hand_made_of_the_logs_numbers_goes_on_bit_for_bit(
    leads: bool, height: float, pitch: float, steps: int
) -> None:
    hand = LedHand()
    hand.ask(asked(leads=leads, height=height, pitch=pitch, push=(5.0, 0.0, 1.0)), NOW)
    for _ in range(steps):
        hand.advance(DT)
    other = LedHand.of_numbers(hand.numbers())
    for _ in range(200):
        hand.advance(DT)
        other.advance(DT)
        assert other.numbers() == hand.numbers()
        assert (other.over(NOW), other.push) == (hand.over(NOW), hand.push)


RATE_MAX = 0.5
PLACES = st.floats(-10.0, 10.0)


@given(st.lists(st.tuples(PLACES, st.floats(1e-4, 2.0)), max_size=30))
def test_a_coordinate_never_moves_faster_than_its_limit_whatever_the_step(
    asked: list[tuple[float, float]],
) -> None:
    at = rate = 0.0
    for wanted, dt in asked:
        before = at
        at, rate = follow(wanted, at, rate, RATE_MAX, dt)
        assert abs(at - before) <= RATE_MAX * dt + 1e-9
        assert abs(rate) <= RATE_MAX + 1e-9
        assert math.isfinite(at)


@given(PLACES, st.integers(1, 20))
def test_a_coordinate_arrives_without_overshoot_and_rests(wanted: float, per_10_ms: int) -> None:
    at, rate, dt = 0.0, 0.0, 0.01 / per_10_ms
    for _ in range(round((abs(wanted) / RATE_MAX + 20.0 / BANDWIDTH) / dt)):
        at, rate = follow(wanted, at, rate, RATE_MAX, dt)
        assert abs(at) <= abs(wanted) + 1e-3
    assert abs(at - wanted) < 1e-3
    assert abs(rate) < 1e-2


def test_within_its_limit_a_coordinate_is_the_critically_damped_solution() -> None:
    at, rate, dt, wanted = 0.0, 0.0, 1e-3, 0.01
    for step in range(1, 1000):
        at, rate = follow(wanted, at, rate, RATE_MAX, dt)
        w_t = BANDWIDTH * step * dt
        assert abs(at - wanted * (1.0 - (1.0 + w_t) * math.exp(-w_t))) < 1e-9
