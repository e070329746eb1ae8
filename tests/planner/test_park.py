"""When a robot parks, what it carries then, and what gives height and pitch back to the person."""

from __future__ import annotations

import msgspec
import pytest

from services.planner.watch.park import (
    AWAY_NS,
    BENT,
    BUMPED_NS,
    CAP,
    FOLLOW_S,
    LASTS_NS,
    LIFTS,
    PITCHED,
    PULL,
    PULL_NS,
    ParkLaw,
    ParkState,
    Touch,
)
from shared.bus.messages import Park, Wearing
from shared.clock import NS_PER_S
from shared.config.robot_config import GRAVITY
from tests.planner.states import DT, TICK_NS
from tests.robots import ROBOT

T0 = 5_000_000_000
PARK = msgspec.structs.replace(ROBOT.park, enabled=True)
STILL_NS = round(PARK.still_s * NS_PER_S)
CROUCHED = Touch(-10.0, 0.0, (0.0, 0.0), (CAP[1], 0.0, 0.0), (0.0, 0.0), 0.0)
"""Somebody rests 10 N on it."""


class Worn:
    """A robot that a person wears, tick by tick."""

    def __init__(self) -> None:
        self.law, self.state, self.now_ns = ParkLaw(PARK, ROBOT.assist), ParkState(), T0
        self.assist = 0.0

    def feel(
        self, touch: Touch | None, lasts_ns: int, park: Park = Park.AUTO, *, may: bool = True
    ) -> Wearing:
        """Let a touch last; return what the planner makes of it."""
        for _ in range(0, lasts_ns, TICK_NS):
            self.now_ns += TICK_NS
            self.assist = self.law.advance(self.state, self.now_ns, touch, park, DT, may=may)
        return self.state.reported(self.now_ns)


@pytest.fixture
def parked() -> Worn:
    worn = Worn()
    assert worn.feel(CROUCHED, STILL_NS + 2 * TICK_NS) is Wearing.RESTS
    return worn


@pytest.mark.parametrize(
    ("pose", "rates", "parks"),
    [
        ((BENT - 0.01, 0.0, 0.0), (0.0, 0.0), True),
        ((-0.5, PITCHED + 0.01, 0.0), (0.0, 0.0), True),
        ((BENT + 0.01, PITCHED - 0.01, 0.0), (0.0, 0.0), False),
        ((BENT - 0.01, 0.0, 0.0), (0.03, 0.0), False),
        ((BENT - 0.01, 0.0, 0.0), (0.0, 0.06), False),
    ],
)
def test_it_parks_where_it_stands_still_in_a_working_pose(
    pose: tuple[float, float, float], rates: tuple[float, float], parks: bool
) -> None:
    worn, touch = Worn(), CROUCHED._replace(pose=pose, rates=rates)
    assert worn.feel(touch, STILL_NS - TICK_NS) is Wearing.LEADS
    assert worn.feel(touch, NS_PER_S).name == ("RESTS" if parks else "LEADS")
    assert worn.state.closed == parks


def test_parked_the_assist_follows_what_rests_and_led_it_only_falls(parked: Worn) -> None:
    rests = CROUCHED._replace(lifted=-80.0)
    parked.feel(rests, round(FOLLOW_S * NS_PER_S))
    assert parked.assist == pytest.approx(80.0 * 0.63, abs=5.0)
    parked.feel(rests, 5 * NS_PER_S)
    assert parked.assist == pytest.approx(80.0, abs=0.1)
    parked.feel(rests, TICK_NS, may=False)
    parked.feel(CROUCHED._replace(lifted=-150.0), NS_PER_S, may=False)
    assert parked.assist == pytest.approx(80.0, abs=1.0)
    parked.feel(CROUCHED, 5 * NS_PER_S, may=False)
    assert parked.assist == pytest.approx(10.0, abs=0.1)


def test_a_parked_robot_that_sank_lifts_itself_and_a_led_one_does_not(parked: Worn) -> None:
    """Friction hides a part of the load, and the person's legs take up another."""
    sunk = CROUCHED._replace(sinks=0.005)
    parked.feel(sunk, 5 * NS_PER_S)
    assert parked.assist == pytest.approx(10.0 + FOLLOW_S * LIFTS * 0.005, abs=0.1)
    parked.feel(sunk, 5 * NS_PER_S, may=False)
    assert parked.assist == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize(("knee", "most"), [(CAP[0], 0.0), (CAP[1], ROBOT.assist.force_max)])
def test_the_pose_limits_what_may_rest_on_it(parked: Worn, knee: float, most: float) -> None:
    parked.feel(CROUCHED._replace(lifted=-400.0, pose=(knee, 0.0, 0.0)), 5 * NS_PER_S)
    assert parked.assist == pytest.approx(most, abs=0.1)


def test_a_sensor_that_drifts_becomes_no_assist_and_a_real_load_pushes_nobody(parked: Worn) -> None:
    """The joints say that a load was taken off by as much as rests on the sensor."""
    drifts = CROUCHED._replace(lifted=-30.0, pose=(CAP[1], 0.0, -30.0 / GRAVITY))
    parked.feel(drifts, 5 * NS_PER_S)
    assert parked.assist == pytest.approx(0.0, abs=0.1)
    loaded = CROUCHED._replace(lifted=-5.0, pose=(CAP[1], 0.0, 30.0 / GRAVITY))
    parked.feel(loaded, 5 * NS_PER_S)
    assert parked.assist == pytest.approx(5.0, abs=0.1)


PULLS = CROUCHED._replace(lifted=PARK.open_n + 1.0)
BACK = CROUCHED._replace(moment=-PARK.open_back_nm - 1.0)


@pytest.mark.parametrize("opens", [PULLS, BACK])
def test_a_pull_up_or_back_that_lasts_gives_it_back_and_a_bump_does_not(
    parked: Worn, opens: Touch
) -> None:
    assert parked.feel(opens, LASTS_NS - TICK_NS) is Wearing.RESTS
    assert parked.feel(CROUCHED, TICK_NS) is Wearing.BUMPED
    assert parked.feel(CROUCHED, BUMPED_NS) is Wearing.RESTS
    assert parked.feel(opens, LASTS_NS + 2 * TICK_NS) is Wearing.LEADS
    assert not parked.state.closed


def test_weight_taken_off_is_no_pull(parked: Worn) -> None:
    parked.feel(CROUCHED._replace(lifted=-150.0), 3 * NS_PER_S)
    assert parked.feel(CROUCHED._replace(lifted=5.0), NS_PER_S) is Wearing.RESTS
    assert parked.assist == pytest.approx(0.0, abs=10.0)


def test_a_person_who_is_gone_and_one_who_pulls_along_the_floor_are_told(parked: Worn) -> None:
    gone = CROUCHED._replace(lifted=0.0)
    assert parked.feel(gone, AWAY_NS - TICK_NS) is Wearing.RESTS
    assert parked.feel(gone, 2 * TICK_NS) is Wearing.AWAY
    assert parked.state.closed
    assert parked.feel(CROUCHED._replace(level=(-PULL - 1.0, 0.0)), PULL_NS) is Wearing.RESTS
    assert parked.feel(CROUCHED._replace(level=(0.0, PULL + 1.0)), 2 * TICK_NS) is Wearing.PULLS
    assert parked.state.closed


@pytest.mark.parametrize("how", ["never", "open", "may not"])
def test_who_asks_for_it_leads_at_once(parked: Worn, how: str) -> None:
    park = {"never": Park.NEVER, "open": Park.OPEN}.get(how, Park.AUTO)
    assert parked.feel(CROUCHED, TICK_NS, park, may=how != "may not") is Wearing.LEADS


def test_without_a_wrench_it_stays_as_it_is(parked: Worn) -> None:
    parked.feel(CROUCHED._replace(lifted=-60.0), 3 * NS_PER_S)
    assert parked.feel(None, NS_PER_S) is Wearing.RESTS
    assert parked.assist == pytest.approx(60.0, abs=0.1)
