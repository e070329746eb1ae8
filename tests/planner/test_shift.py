"""Where the closed directions are asked to be: followed without a jump, within limits."""

from __future__ import annotations

import msgspec
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.planner.intents import OperatorRequest
from services.planner.law.shift import ROWS, SHIFT_S, ShiftReference, ShiftState
from services.planner.planner import Planner
from shared.bus.messages import STRAIGHT, Vector4
from shared.config.robot_config import RobotConfig

LARGEST = (0.03, 0.04, 0.06, 0.12)
DT = 0.004
Array = NDArray[np.float64]
asked = st.tuples(*[st.floats(-1e6, 1e6) | st.floats(-0.15, 0.15)] * 4)


def now(follower: ShiftReference) -> tuple[Array, Array]:
    """Return the shift of p and its rate."""
    p, pdot = np.zeros(6), np.zeros(6)
    follower.add_to(p, pdot)
    return p, pdot


def advanced(follower: ShiftReference, wanted: Vector4, dt: float) -> tuple[Array, Array]:
    follower.advance(wanted, dt)
    return now(follower)


@given(course=st.lists(st.tuples(asked, st.sampled_from([DT, 2 * DT, 0.02])), max_size=60))
def test_neither_shift_nor_rate_is_ever_beyond_its_limit(
    course: list[tuple[Vector4, float]],
) -> None:
    follower, last = ShiftReference(LARGEST), np.zeros(6)
    for wanted, dt in course:
        shift, rate = advanced(follower, wanted, dt)
        assert np.all(np.abs(shift[list(ROWS)]) <= np.multiply(LARGEST, 1.0 + 1e-9))
        assert np.all(np.abs(rate[list(ROWS)]) <= np.divide(LARGEST, SHIFT_S) + 1e-12)
        np.testing.assert_allclose(shift - last, dt * rate, atol=1e-12)
        assert not shift[[2, 4]].any(), "height and pitch are the hand's"
        last = shift


@given(wanted=asked)
def test_it_comes_to_what_is_asked_or_as_near_as_it_may(wanted: Vector4) -> None:
    follower = ShiftReference(LARGEST)
    for _ in range(1200):
        shift, rate = advanced(follower, wanted, DT)
    np.testing.assert_allclose(
        shift[list(ROWS)], np.clip(wanted, np.negative(LARGEST), LARGEST), atol=1e-5
    )
    assert np.abs(rate).max() < 1e-4


def test_a_robot_file_without_limits_stands_straight() -> None:
    follower = ShiftReference(STRAIGHT)
    for _ in range(100):
        shift, rate = advanced(follower, (0.1, 0.1, 0.1, 0.1), DT)
    assert not shift.any()
    assert not rate.any()


def test_it_rests_where_it_is_while_it_is_not_led() -> None:
    follower = ShiftReference(LARGEST)
    for _ in range(100):
        there, _ = advanced(follower, (0.03, 0.0, 0.0, 0.1), DT)
    follower.rest()
    shift, rate = now(follower)
    np.testing.assert_array_equal(shift, there)
    assert not rate.any()


def test_a_follower_that_goes_on_from_its_memory_goes_on_bit_for_bit() -> None:
    follower, twin = ShiftReference(LARGEST), ShiftReference(LARGEST)
    for _ in range(40):
        follower.advance((0.03, -0.04, 0.0, 0.1), DT)
    text = msgspec.json.encode(follower.state)
    twin.state = msgspec.json.decode(text, type=ShiftState)
    for _ in range(40):
        for mine, other in zip(
            advanced(follower, STRAIGHT, DT), advanced(twin, STRAIGHT, DT), strict=True
        ):
            np.testing.assert_array_equal(mine, other)


def test_a_planner_goes_on_with_the_wish_it_had(robot: RobotConfig) -> None:
    planner = Planner(robot, 1)
    planner.receive_request(OperatorRequest(0.0, (0.01, 0.0, 0.0, 0.02)))
    assert planner.status(0, 0.0).shift_requested == (0.01, 0.0, 0.0, 0.02)
    twin = Planner(robot, 1)
    twin.restore(planner.snapshot())
    assert twin.status(0, 0.0).shift_requested == (0.01, 0.0, 0.0, 0.02)
