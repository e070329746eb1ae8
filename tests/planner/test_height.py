"""The reference of a height that the robot goes to by itself: bounded, without a step, leashed."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.law.closed_reference import (
    ACCELERATION,
    FADE_RATE,
    FORCE_MAX,
    FORCE_RATE,
    HOLD_S,
    LEAD_ANGLE,
    LEAD_MAX,
    LEAD_PITCH,
    MOMENT_FADE_RATE,
    MOMENT_FIRST,
    MOMENT_MAX,
    RATE_MAX,
    RELEASED_S,
    STOPPING,
    HeightReference,
    HeightState,
    Released,
    Toward,
)
from shared.arrays import Array
from tests.planner.states import DT, Kept

LED: Released = (False, False)
DOWN, UP, PERSON = Toward.DOWN, Toward.UP, Toward.PERSON
T_Z = 4.0
KNEES = (-2.5, -0.2)
SLOPE = 0.1
"""m of the COM per rad of the knees."""


class Body:
    """A body that follows the reference, or that a hand holds where it is."""

    def __init__(self, knee: float = -1.0, pitch: float = 0.1, rate: float = 0.0) -> None:
        self.law = Kept(HeightReference(KNEES), HeightState(T_z=T_Z))
        self.p, self.pdot = np.zeros(6), np.zeros(6)
        self.p[2], self.p[4], self.pdot[2] = 1.0 + SLOPE * knee, pitch, rate
        self.held = False

    @property
    def knee(self) -> float:
        return float(self.p[2] - 1.0) / SLOPE

    def step(
        self, toward: Toward, released: Released = LED, drive: float = 0.0
    ) -> tuple[Array, Array]:
        knees = self.knee, self.knee + 0.02
        self.force, self.moment = self.law.advance(
            toward, released, drive, self.p, self.pdot, knees, DT
        )
        p_ref, pdot_ref = self.p.copy(), self.pdot.copy()  # open: the person leads
        self.law.state.apply(p_ref, pdot_ref)
        if not self.held:
            self.pdot[2] = (p_ref[2] - self.p[2]) / DT if self.law.state.hold[0] == 1.0 else 0.0
            self.p[2] = p_ref[2]
        return p_ref, pdot_ref


@pytest.mark.parametrize(("toward", "end"), [(DOWN, KNEES[0]), (UP, KNEES[1] - 0.02)])
def test_it_ends_at_the_end_of_the_knees_way_and_goes_no_further(
    toward: Toward, end: float
) -> None:
    """It presses nobody on its way down, and pushes nobody as it rises freely."""
    body = Body()
    for _ in range(4000):
        body.step(toward)
        assert body.force < 3.0
    assert body.knee == pytest.approx(end, abs=0.01)
    body.law.state.reset()  # the planner does not lead
    assert not body.law.state.is_active


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


@pytest.mark.parametrize("T_z", [4.0, 10.0])
def test_the_reference_hardly_leads_a_robot_that_is_held_and_a_force_makes_up_for_it(
    T_z: float,
) -> None:
    law, p, rest = Kept(HeightReference(KNEES), HeightState(T_z=T_z)), np.zeros(6), (-1.0, -1.0)
    still = np.zeros(6)
    forces = [law.advance(UP, LED, 0.0, p, still, rest, DT)[0] for _ in range(2000)]
    assert law.state.height == pytest.approx(min(LEAD_MAX, LEAD_ANGLE / T_z))
    assert max(forces) == FORCE_MAX
    assert max(np.diff(forces)) <= 1.01 * FORCE_RATE * DT
    for _ in range(round(FORCE_MAX / FADE_RATE / DT) - 10):
        law.advance(PERSON, LED, 0.0, p, still, rest, DT)
    assert law.state.is_active, "the force fades, and is not dropped"
    for _ in range(20):
        law.advance(PERSON, LED, 0.0, p, still, rest, DT)
    assert not law.state.is_active


@pytest.mark.parametrize("released", [(True, False), (False, True), (True, True)])
def test_what_nobody_leads_stays_where_it_is_and_the_rest_is_open(released: Released) -> None:
    body = Body(rate=0.15)
    for _ in range(round((RELEASED_S + 0.15 / STOPPING) / DT) + 1):
        body.step(PERSON, released)
    body.held = True
    body.p[2] += 0.005
    body.p[4] += 0.05
    p_ref, pdot_ref = body.step(PERSON, released)
    for row, closed, way in ((2, released[0], 0.005), (4, released[1], 0.05)):
        assert body.p[row] - p_ref[row] == pytest.approx(way if closed else 0.0, abs=2e-4)
    assert pdot_ref[2] == (0.0 if released[0] else body.pdot[2])


def test_a_height_that_nobody_leads_stops_soon_and_lifts_nobody() -> None:
    body = Body(rate=0.16)
    body.held = True  # someone presses it down
    start = body.p[2]
    for _ in range(2000):
        p_ref, _ = body.step(PERSON, (True, True))
    assert body.law.state.height - start <= 0.16**2 / (2.0 * STOPPING) + 1e-3
    assert body.law.state.rate == 0.0
    assert body.force == 0.0
    assert p_ref[2] >= body.p[2]


@pytest.mark.parametrize("drive", [-4.0, 3.0, 50.0])
def test_a_moment_holds_the_torso_that_nobody_leads_and_fades_under_a_hand(drive: float) -> None:
    body = Body()
    body.step(PERSON, (False, True), drive)
    assert body.moment == pytest.approx(-min(drive, MOMENT_FIRST), abs=1e-6)
    body.p[4] += 0.1
    for _ in range(5000):
        body.step(PERSON, (False, True), drive)
    assert body.moment == -MOMENT_MAX
    for _ in range(round(MOMENT_MAX / MOMENT_FADE_RATE / DT) + 30):
        body.step(PERSON)
    assert body.moment == 0.0
    assert not body.law.state.is_active
