"""What a person or a tool asks for: heard, faded, kept within limits, and slow enough."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.intents import Intents, OperatorRequest
from services.planner.law.closed_reference import ROWS, SHIFT_S, ShiftReference, ShiftState
from shared.arrays import Array
from shared.bus.messages import STRAIGHT, OperatorIntent, Vector4
from shared.clock import NS_PER_MS
from tests.planner.states import DT, ROBOT, Kept

T0 = 5_000_000_000


def intent(
    assist_n: float = 0.0, shift: Vector4 = STRAIGHT, *, sit: bool = False
) -> OperatorIntent:
    return OperatorIntent(t_ns=1, seq=1, assist_n=assist_n, shift=shift, source="a test", sit=sit)


def late_ns(share: float) -> int:
    """Return when so much of the fade is over."""
    assist = ROBOT.assist
    return T0 + round(assist.stale_ms * NS_PER_MS + share * assist.fade_s * 1e9)


def test_a_message_is_given_until_it_is_stale() -> None:
    intents = Intents(ROBOT.assist)
    assert intents.request(T0) == OperatorRequest(0.0, STRAIGHT, ""), "nothing is requested yet"
    intents.receive(intent(80.0, (0.01, 0.0, 0.0, -0.02), sit=True), T0)
    for now in (T0, T0 + 1, late_ns(0.0)):
        assert intents.request(now) == OperatorRequest(
            80.0, (0.01, 0.0, 0.0, -0.02), "a test", sit=True
        )


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0, 1.5, 1000.0])
def test_then_it_fades_to_nothing_and_stays_there(share: float) -> None:
    """Sinking ends at once."""
    intents = Intents(ROBOT.assist)
    intents.receive(intent(80.0, (0.01, 0.0, 0.0, -0.02), sit=True), T0)
    request = intents.request(late_ns(share))
    left = max(0.0, 1.0 - share)
    assert request.assist_n == pytest.approx(80.0 * left)
    assert request.shift == pytest.approx((0.01 * left, 0.0, 0.0, -0.02 * left))
    assert (request.source, request.sit) == ("", False)
    assert ROBOT.assist.force_max / ROBOT.assist.fade_s < ROBOT.assist.rate_max
    again_ns = late_ns(share)
    intents.receive(intent(60.0), again_ns)
    assert intents.request(again_ns + 1).assist_n == 60.0


@pytest.mark.parametrize(
    "bad",
    [
        *(intent(x) for x in (math.nan, math.inf, -math.inf)),
        *(intent(1.0, (0.0, x, 0.0, 0.0)) for x in (math.nan, math.inf, -math.inf)),
    ],
)
def test_an_intent_without_numbers_is_ignored(bad: OperatorIntent) -> None:
    intents = Intents(ROBOT.assist)
    intents.receive(intent(80.0), T0)
    before = intents.request(T0)
    intents.receive(bad, T0 + 1)
    assert intents.request(T0 + 2) == before
    assert before.assist_n == 80.0


# ---- where the closed directions are asked to be

LARGEST = (0.03, 0.04, 0.06, 0.12)
asked = st.tuples(*[st.floats(-1e6, 1e6) | st.floats(-0.15, 0.15)] * 4)


def now(follower: Kept) -> tuple[Array, Array]:
    """Return the shift of p and its rate."""
    p, pdot = np.zeros(6), np.zeros(6)
    follower.state.add_to(p, pdot)
    return p, pdot


def advanced(follower: Kept, wanted: Vector4, dt: float) -> tuple[Array, Array]:
    follower.advance(wanted, dt)
    return now(follower)


@given(course=st.lists(st.tuples(asked, st.sampled_from([DT, 2 * DT, 0.02])), max_size=60))
def test_shift_and_rate_stay_within_their_limits(course: list[tuple[Vector4, float]]) -> None:
    follower, last = Kept(ShiftReference(LARGEST), ShiftState()), np.zeros(6)
    for wanted, dt in course:
        shift, rate = advanced(follower, wanted, dt)
        assert np.all(np.abs(shift[list(ROWS)]) <= np.multiply(LARGEST, 1.0 + 1e-9))
        assert np.all(np.abs(rate[list(ROWS)]) <= np.divide(LARGEST, SHIFT_S) + 1e-12)
        np.testing.assert_allclose(shift - last, dt * rate, atol=1e-12)
        assert not shift[[2, 4]].any(), "height and pitch are the hand's"
        last = shift


@pytest.mark.parametrize("largest", [LARGEST, STRAIGHT], ids=["limits", "none: it stands straight"])
@settings(max_examples=20)
@given(wanted=asked)
def test_it_comes_to_what_is_asked_or_as_near_as_it_may(largest: Vector4, wanted: Vector4) -> None:
    follower = Kept(ShiftReference(largest), ShiftState())
    for _ in range(1200):
        shift, rate = advanced(follower, wanted, DT)
    np.testing.assert_allclose(
        shift[list(ROWS)], np.clip(wanted, np.negative(largest), largest), atol=1e-5
    )
    assert np.abs(rate).max() < 1e-4


def test_it_rests_where_it_is_while_it_is_not_led() -> None:
    follower = Kept(ShiftReference(LARGEST), ShiftState())
    for _ in range(100):
        there, _ = advanced(follower, (0.03, 0.0, 0.0, 0.1), DT)
    follower.state.stop()
    shift, rate = now(follower)
    np.testing.assert_array_equal(shift, there)
    assert not rate.any()
