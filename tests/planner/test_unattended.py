"""How far it drifts once the hand has left it."""

from __future__ import annotations

import math

import pytest

from services.planner.watch.unattended import ARM, HAND_LOST_NS, HAND_MIN, Unattended
from shared.bus.messages import Pair
from shared.state import copied

T0 = 5_000_000_000
HERE: Pair = (0.8, 0.1)


def left(at: Pair = HERE) -> Unattended:
    """Return one that a hand has left."""
    found = Unattended()
    assert found.drift(T0, at, 2.0 * HAND_MIN[0], 0.0) == 0.0
    assert found.drift(T0 + HAND_LOST_NS, at, 0.0, 0.0) == 0.0
    return found


@pytest.mark.parametrize(
    ("pose", "drift"),
    [((0.83, 0.1), 0.03), ((0.75, 0.1), 0.05), ((0.8, 0.3), 0.2 * ARM), ((0.79, -1.9), 2.0 * ARM)],
)
def test_drift_is_measured_from_where_the_hand_left_it(pose: Pair, drift: float) -> None:
    assert left().drift(T0 + HAND_LOST_NS + 1, pose, 0.0, 0.0) == pytest.approx(drift)


def test_a_force_below_what_is_felt_is_no_hand() -> None:
    drift = left().drift(T0 + HAND_LOST_NS + 1, (0.84, 0.1), 0.99 * HAND_MIN[0], 0.99 * HAND_MIN[1])
    assert drift == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("force", "moment"),
    [
        (HAND_MIN[0], 0.0),
        (-HAND_MIN[0], 0.0),
        (0.0, HAND_MIN[1]),
        (0.0, -HAND_MIN[1]),
        (math.nan, math.nan),
    ],
)
def test_with_a_hand_on_it_or_unknown_nothing_drifts(force: float, moment: float) -> None:
    hand = left()
    for tick in range(1000):
        pose = (0.8 + 0.001 * tick, 0.1)
        assert hand.drift(T0 + HAND_LOST_NS + tick + 1, pose, force, moment) == 0.0


def test_a_hand_that_is_not_felt_for_a_moment_has_not_let_go() -> None:
    hand = Unattended()
    hand.drift(T0, HERE, 2.0 * HAND_MIN[0], 0.0)
    assert hand.drift(T0 + HAND_LOST_NS, (0.9, 0.1), 0.0, 0.0) == 0.0
    assert hand.drift(T0 + HAND_LOST_NS + 1, (0.95, 0.1), 0.0, 0.0) == pytest.approx(0.05)


def test_it_goes_on_from_a_memory() -> None:
    hand, twin = left(), Unattended()
    twin.state = copied(hand.state)
    for each in (hand, twin):
        each.drift(T0 + HAND_LOST_NS + 1, (0.9, 0.2), 0.0, 0.0)
    assert twin.state == hand.state
