"""The reference of a height that the robot goes to by itself: bounded, without a step, leashed."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.law.height import (
    ACCELERATION,
    FADE_RATE,
    FORCE_MAX,
    FORCE_RATE,
    HOLD_S,
    LEAD_ANGLE,
    LEAD_MAX,
    LEAD_PITCH,
    RATE_MAX,
    HeightReference,
    Toward,
)
from shared.arrays import Array
from tests.planner.states import DT

DOWN, UP, PERSON = Toward.DOWN, Toward.UP, Toward.PERSON
T_Z = np.full(12, 4.0)
KNEES = (-2.5, -0.2)
SLOPE = 0.1
"""m of the COM per rad of the knees."""


class Body:
    """A body that follows the reference, or that a hand holds where it is."""

    def __init__(self, knee: float = -1.0, pitch: float = 0.1, rate: float = 0.0) -> None:
        self.law = HeightReference(KNEES)
        self.p, self.pdot = np.zeros(6), np.zeros(6)
        self.p[2], self.p[4], self.pdot[2] = 1.0 + SLOPE * knee, pitch, rate
        self.held = False

    @property
    def knee(self) -> float:
        return float(self.p[2] - 1.0) / SLOPE

    def step(self, toward: Toward) -> tuple[Array, Array]:
        knees = self.knee, self.knee + 0.02
        self.force = self.law.advance(toward, self.p, self.pdot, T_Z, knees, DT)
        p_ref, pdot_ref = self.p.copy(), self.pdot.copy()  # open: the person leads
        self.law.apply(p_ref, pdot_ref)
        if not self.held:
            self.pdot[2] = (p_ref[2] - self.p[2]) / DT if self.law.state.hold == 1.0 else 0.0
            self.p[2] = p_ref[2]
        return p_ref, pdot_ref


@pytest.mark.parametrize(("toward", "end"), [(DOWN, KNEES[0]), (UP, KNEES[1] - 0.02)])
def test_it_ends_at_the_end_of_the_knees_way_and_goes_no_further(
    toward: Toward, end: float
) -> None:
    body = Body()
    for _ in range(4000):
        body.step(toward)
    assert body.knee == pytest.approx(end, abs=0.01)


@pytest.mark.parametrize("toward", [DOWN, UP])
@pytest.mark.parametrize("rate", [-0.3, 0.0, 0.2])
def test_its_rate_is_bounded_and_nothing_steps(toward: Toward, rate: float) -> None:
    body = Body(rate=rate)
    first, first_rate = body.step(toward)
    assert first[2] == pytest.approx(body.p[2], abs=2e-3)
    assert first[4] == pytest.approx(body.p[4])
    assert first_rate[2] == pytest.approx(rate, abs=ACCELERATION * DT)
    rates = []
    for _ in range(2000):
        body.step(toward)
        rates.append(body.law.state.rate)
    assert np.abs(np.diff(rates)).max() <= ACCELERATION * DT * 1.001
    settled = rates[round(0.5 / ACCELERATION / DT) :]
    assert np.abs(settled).max() <= RATE_MAX * 1.001


def test_a_hand_that_holds_the_robot_up_stops_it() -> None:
    body = Body()
    body.held = True
    for _ in range(3000):
        p_ref, _ = body.step(DOWN)
        assert p_ref[2] >= body.p[2] - LEAD_MAX - 1e-12
    body.p[4] += 1.0  # and one that turns it is not fought without end
    p_ref, _ = body.step(DOWN)
    assert p_ref[4] == pytest.approx(body.p[4] - LEAD_PITCH)


def test_given_back_the_person_leads_again() -> None:
    body = Body()
    for _ in range(500):
        body.step(DOWN)
    for _ in range(round(HOLD_S / DT) + 1):
        body.step(PERSON)
    p_ref, pdot_ref = body.step(PERSON)
    assert (p_ref == body.p).all()
    assert (pdot_ref == body.pdot).all()


def test_the_planner_not_leading_ends_it_at_once() -> None:
    body = Body()
    body.step(DOWN)
    body.law.reset()
    assert body.law.state.hold == 0.0


@pytest.mark.parametrize("T_z", [4.0, 10.0])
def test_the_reference_hardly_leads_a_robot_that_is_held_and_a_force_makes_up_for_it(
    T_z: float,
) -> None:
    law, p, rest = HeightReference(KNEES), np.zeros(6), (-1.0, -1.0)
    forces = [law.advance(UP, p, np.zeros(6), np.full(12, T_z), rest, DT) for _ in range(2000)]
    assert law.state.height == pytest.approx(min(LEAD_MAX, LEAD_ANGLE / T_z))
    assert max(forces) == FORCE_MAX
    assert max(np.diff(forces)) <= 1.01 * FORCE_RATE * DT
    for _ in range(round(FORCE_MAX / FADE_RATE / DT) - 10):
        law.advance(PERSON, p, np.zeros(6), T_Z, rest, DT)
    assert law.is_active, "the force fades, and is not dropped"
    for _ in range(20):
        law.advance(PERSON, p, np.zeros(6), T_Z, rest, DT)
    assert not law.is_active


def test_going_down_presses_nobody_and_rising_freely_pushes_nobody() -> None:
    for toward in (DOWN, UP):
        body = Body()
        for _ in range(1000):
            body.step(toward)
        assert body.force < 3.0
