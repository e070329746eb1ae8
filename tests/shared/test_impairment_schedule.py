"""What is done to links, and when: begun, hidden, ended and told."""

from __future__ import annotations

import math

import pytest

from shared.bus.traces import LinkEvent
from shared.config.impairment import Direction, Impairment
from shared.exceptions import ConfigError
from shared.links import COMMANDS, DIRECTIONS, WRENCHES
from shared.network.impairment_schedule import ImpairmentSchedule
from shared.network.proxy_protocol import RequestedImpairment

CUT = Impairment(partition=True)
LATE = Impairment(delay_ms=5.0)


class Rig:
    def __init__(self) -> None:
        self.directions = {name: Direction(name, 0) for name in DIRECTIONS}
        self.told: list[LinkEvent] = []
        self.impairments = ImpairmentSchedule(self.directions, self.told.append)

    def begun(self) -> list[tuple[int, bool]]:
        return [(event.number, event.active) for event in self.told]


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_what_is_planned_begins_when_it_is_due_and_ends_at_its_time(rig: Rig) -> None:
    number = rig.impairments.plan(WRENCHES, LATE, 2.0, 3.0)
    assert rig.impairments.next_due == 2.0
    assert not rig.impairments.advance(1.9, 19)
    assert rig.told == []
    assert rig.impairments.advance(2.0, 20)
    assert rig.directions[WRENCHES].active is not None
    assert rig.impairments.next_due == 3.0
    assert rig.impairments.advance(3.1, 31)
    assert rig.begun() == [(number, True), (number, False)]
    assert [event.t_ns for event in rig.told] == [20, 31]
    assert rig.impairments.next_due == math.inf


def test_what_is_due_together_begins_in_the_order_of_its_times(rig: Rig) -> None:
    late = rig.impairments.plan(WRENCHES, LATE, 2.0, 9.0)
    early = rig.impairments.plan(WRENCHES, LATE, 1.0, 9.0)
    rig.impairments.advance(5.0, 5)
    assert rig.begun() == [(early, True), (late, True)]


def test_what_would_be_over_before_it_is_seen_never_begins(rig: Rig) -> None:
    rig.impairments.plan(WRENCHES, LATE, 1.0, 1.5)
    assert rig.impairments.advance(2.0, 2)
    assert rig.told == []
    assert rig.impairments.requested == {}


def test_clearing_ends_what_touches_a_link_and_keeps_it_from_beginning(rig: Rig) -> None:
    rig.impairments.begin("planner->joints", LATE, math.inf, 0)
    rig.impairments.plan("planner->joints", LATE, 1.0, math.inf)
    kept = rig.impairments.plan(WRENCHES, LATE, 1.0, math.inf)
    assert rig.impairments.clear("planner->knee_left", 0) == 2
    assert list(rig.impairments.requested) == [kept]
    rig.told.clear()
    rig.impairments.advance(1.0, 1)
    assert rig.begun() == [(kept, True)]


def test_what_is_planned_for_no_link_is_refused_and_not_kept(rig: Rig) -> None:
    with pytest.raises(ConfigError):
        rig.impairments.plan("elbow", LATE, 1.0, 2.0)
    assert rig.impairments.requested == {}
    assert rig.impairments.next_due == math.inf


def test_a_hidden_impairment_is_reported_with_its_directions(rig: Rig) -> None:
    everywhere = rig.impairments.begin("all", LATE, math.inf, 0)
    cut = rig.impairments.begin("planner->joints", CUT, math.inf, 0)
    later = rig.impairments.begin("planner->knee_left", LATE, math.inf, 0)
    waits = rig.impairments.plan("all", CUT, 5.0, math.inf)
    assert set(rig.impairments.hidden(everywhere)) == set(COMMANDS)
    assert rig.impairments.hidden(cut) == ()
    assert rig.impairments.hidden(later) == ("planner->knee_left",)
    assert rig.impairments.hidden(waits) == ()
    rig.impairments.end(cut, 0)
    assert rig.impairments.hidden(everywhere) == ("planner->knee_left",)


@pytest.mark.parametrize(
    ("link", "in_s", "hidden", "words"),
    [
        (WRENCHES, 0.0, (), f"{WRENCHES} delay=5ms"),
        (WRENCHES, 0.0, (WRENCHES,), f"{WRENCHES} delay=5ms (hidden)"),
        ("planner->joints", 0.0, COMMANDS[:2], "planner->joints delay=5ms (hidden on 2 of 6)"),
        (WRENCHES, 2.04, (), f"{WRENCHES} delay=5ms (in 2.0 s)"),
    ],
)
def test_an_inactive_impairment_names_the_reason(
    link: str, in_s: float, hidden: tuple[str, ...], words: str
) -> None:
    requested = RequestedImpairment(1, link, LATE.describe(), None, 0, 0, in_s, hidden)
    assert requested.describe() == words
