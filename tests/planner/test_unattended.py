"""Who leads height and pitch: a hand that is lost, a torso that runs away, a hand that is back."""

from __future__ import annotations

import math

import pytest

from services.planner.watch.unattended import (
    ARM,
    HAND_BACK,
    HAND_BACK_NS,
    HAND_LOST_NS,
    HAND_MIN,
    PROOF_NS,
    RUNAWAY,
    Unattended,
)
from shared.bus.messages import Pair
from shared.clock import NS_PER_S
from tests.planner.states import TICK_NS

T0 = 5_000_000_000
HERE: Pair = (0.8, 0.1)
STILL: Pair = (0.0, 0.0)
NO_HAND: Pair = (0.0, 0.0)
DT = TICK_NS / NS_PER_S
GONE, LED = (False, True), (False, False)


def drift(watch: Unattended, at_ns: int, pose: Pair, hand: Pair = NO_HAND) -> float:
    """Return the drift of a robot that is led and does not move, so that it is not released."""
    return watch.advance(T0 + at_ns, pose, STILL, hand, leads=True)


def left() -> Unattended:
    """Return the watch of a robot that a hand has left."""
    watch = Unattended()
    assert drift(watch, 0, HERE, (2.0 * HAND_MIN[0], 0.0)) == 0.0
    assert drift(watch, HAND_LOST_NS, HERE) == 0.0
    return watch


@pytest.mark.parametrize(
    ("pose", "way"),
    [((0.83, 0.1), 0.03), ((0.75, 0.1), 0.05), ((0.8, 0.3), 0.2 * ARM), ((0.79, -1.9), 2.0 * ARM)],
)
def test_drift_is_measured_from_where_the_hand_left_it(pose: Pair, way: float) -> None:
    weak = 0.99 * HAND_MIN[0], 0.99 * HAND_MIN[1]
    for hand in (NO_HAND, weak):
        assert drift(left(), HAND_LOST_NS + 1, pose, hand) == pytest.approx(way)


@pytest.mark.parametrize(
    "hand",
    [
        (HAND_MIN[0], 0.0),
        (-HAND_MIN[0], 0.0),
        (0.0, HAND_MIN[1]),
        (0.0, -HAND_MIN[1]),
        (math.nan, math.nan),
    ],
)
def test_with_a_hand_on_it_or_unknown_nothing_drifts(hand: Pair) -> None:
    watch = left()
    for tick in range(1000):
        assert drift(watch, HAND_LOST_NS + tick + 1, (0.8 + 0.001 * tick, 0.1), hand) == 0.0


def test_a_hand_that_is_not_felt_for_a_moment_has_not_let_go() -> None:
    watch = Unattended()
    drift(watch, 0, HERE, (2.0 * HAND_MIN[0], 0.0))
    assert drift(watch, HAND_LOST_NS, (0.9, 0.1)) == 0.0
    assert drift(watch, HAND_LOST_NS + 1, (0.95, 0.1)) == pytest.approx(0.05)


class Torso:
    """A body that accelerates by itself, or coasts, from the rate at which a hand left it."""

    def __init__(self, rate: float = 0.0, hand: Pair = (0.0, 2.0)) -> None:
        self.watch, self.now_ns = Unattended(), T0
        self.pitch, self.rate = 0.3, rate
        self.step(0.0, hand)

    def step(self, acceleration: float, hand: Pair = NO_HAND, *, leads: bool = True) -> None:
        self.now_ns += TICK_NS
        self.rate += acceleration * DT
        self.pitch += self.rate * DT
        pose, rates = (0.8, self.pitch), (0.0, self.rate)
        self.watch.advance(self.now_ns, pose, rates, hand, leads=leads)

    def run(self, time_s: float, acceleration: float, hand: Pair = NO_HAND) -> tuple[bool, bool]:
        for _ in range(round(time_s / DT)):
            self.step(acceleration, hand)
        return self.watch.released


@pytest.mark.parametrize("rests_n", [0.0, -25.0, 24.0])
@pytest.mark.parametrize("acceleration", [-3.6, 0.5, 3.6])
def test_a_torso_that_turns_by_itself_is_released_early_whatever_rests_on_the_harness(
    acceleration: float, rests_n: float
) -> None:
    """3.6 rad/s^2 were seen: 0.8 rad within a second."""
    torso = Torso()
    while not torso.watch.released[1]:
        torso.step(acceleration, (rests_n, 0.0))
        assert abs(torso.pitch - 0.3) <= RUNAWAY[1]
    assert torso.watch.pitch.drive == pytest.approx(acceleration, rel=0.2)


@pytest.mark.parametrize("rate", [-0.5, 0.3])
def test_a_torso_that_coasts_to_rest_is_not_released(rate: float) -> None:
    torso = Torso(rate)
    assert torso.run(0.3, -rate / 0.3) == LED


@pytest.mark.parametrize("hand", [(0.0, 0.5), (0.0, -0.5), (math.nan, math.nan)])
def test_a_hand_on_it_leads_it_however_it_moves(hand: Pair) -> None:
    assert Torso().run(1.0, 3.6, hand) == LED


def test_a_height_that_falls_by_itself_is_released() -> None:
    watch = Unattended()
    for tick in range(60):
        rate = -0.7 * DT * tick
        watch.advance(T0 + tick * TICK_NS, HERE, (rate, 0.0), NO_HAND, leads=True)
    assert watch.released == (True, False)


def released(hand: Pair = NO_HAND) -> Torso:
    """Return a torso that was released and stands still again."""
    torso = Torso()
    assert torso.run(0.3, 2.0, hand)[1]
    torso.rate = 0.0
    return torso


def test_a_pitch_that_stays_released_closes_the_height_as_well() -> None:
    torso = released()
    torso.run(PROOF_NS / NS_PER_S, 0.0)
    assert torso.watch.released == (True, True)
    torso.run(HAND_BACK_NS / NS_PER_S + 2 * DT, 0.0, (0.0, HAND_BACK[1]))
    assert torso.watch.released == LED, "a hand on the pitch opens both"


@pytest.mark.parametrize("hand", [(HAND_BACK[0], 0.0), (-HAND_BACK[0], 0.0)])
def test_a_height_is_opened_by_more_than_the_weight_of_a_person_who_rests(hand: Pair) -> None:
    torso = released()
    weaker = (0.99 * hand[0], 0.0)
    assert torso.run(1.0, 0.0, weaker) == (True, True)
    assert torso.run(HAND_BACK_NS / NS_PER_S + 2 * DT, 0.0, hand)[1]


def test_a_bump_opens_nothing_but_a_harness_that_falls_silent_or_no_lead_both() -> None:
    torso = released()
    torso.run(0.5, 0.0)
    for _ in range(3):
        torso.run(HAND_BACK_NS / NS_PER_S - 2 * DT, 0.0, (60.0, 5.0))
        assert torso.run(0.1, 0.0) == (True, True)
    torso.step(0.0, (math.nan, math.nan))
    assert torso.watch.released == LED
    torso = released()
    torso.step(0.0, leads=False)
    assert torso.watch.released == LED
