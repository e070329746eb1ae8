"""Two planners by accident: whoever is followed leads on, the other waits and says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.planner.planner import Planner
from services.planner.rival_watch import AGAIN_NS, RivalWatch
from shared.bus.messages import JointState, PlannerMode
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.robot.joints import N_MODULES
from tests.planner.conftest import Closed
from tests.planner.oracle import Array
from tests.planner.test_planner import SESSION, START_NS, lead, receive_all, state

OWN, OTHER = 7, 9
AGE_MAX_NS = 50 * NS_PER_MS
T0 = 1_000_000_000


def following(*sessions: int, age_ns: int = 2 * NS_PER_MS) -> list[JointState]:
    return cast(
        "list[JointState]",
        [SimpleNamespace(session=session, age_ns=age_ns) for session in sessions],
    )


def watch(*sessions: int, own: int = OWN, age_ns: int = 2 * NS_PER_MS) -> RivalWatch:
    rival = RivalWatch()
    rival.advance(T0, own, following(*sessions, age_ns=age_ns), AGE_MAX_NS)
    return rival


def test_a_newcomer_yields_to_whom_the_modules_follow() -> None:
    rival = watch(*[OTHER] * 6)
    assert rival.yields
    assert str(OTHER) in rival.describe()


def test_one_who_leads_does_not_yield_to_a_newcomer_that_caught_a_module() -> None:
    assert not watch(OWN, OWN, OWN, OWN, OWN, OTHER).yields


def test_modules_that_follow_nobody_or_whose_command_is_too_old_make_no_rival() -> None:
    assert not watch(*[0] * 6).yields
    assert not watch(*[OTHER] * 6, age_ns=AGE_MAX_NS + 1).yields
    assert not watch(*[OTHER] * 6, age_ns=-1).yields


@given(st.lists(st.sampled_from([0, OWN, OTHER]), min_size=6, max_size=6))
def test_of_two_planners_never_both_yield_and_never_both_go_on_while_both_are_followed(
    sessions: list[int],
) -> None:
    one, two = watch(*sessions, own=OWN).yields, watch(*sessions, own=OTHER).yields
    assert not (one and two)
    if {OWN, OTHER} <= set(sessions):
        assert one != two


def test_it_goes_on_when_the_other_has_not_been_followed_for_half_a_second() -> None:
    rival = watch(*[OTHER] * 6)
    gone = following(*[OTHER] * 6, age_ns=60 * NS_PER_MS)
    assert not rival.advance(T0 + AGAIN_NS - 1, OWN, gone, AGE_MAX_NS)
    assert rival.yields, "it may only have been held up"
    assert rival.advance(T0 + AGAIN_NS, OWN, gone, AGE_MAX_NS)
    assert not rival.yields
    assert rival.describe() == ""


@pytest.fixture
def planner(robot: RobotConfig) -> Planner:
    return Planner(robot, SESSION)


@pytest.fixture
def q(closed: Closed) -> Array:
    return closed(1.188)


def test_a_planner_beside_one_that_leads_sends_nothing_and_says_why(
    planner: Planner, q: Array
) -> None:
    for tick in range(20):
        now_ns = START_NS + 4 * NS_PER_MS * tick
        receive_all(planner, q, now_ns, seq=tick, session=OTHER)
        assert planner.tick(now_ns) == []
    status = planner.status(now_ns, 0.0)
    assert (status.mode, status.hold) == (PlannerMode.YIELDING, True)
    assert f"another planner leads (session {OTHER})" in status.why


def test_ready_counts_only_for_ones_own_session(planner: Planner, q: Array) -> None:
    """A module that is ready for another planner's commands has none of this one."""
    for tick in range(20):
        now_ns = START_NS + 4 * NS_PER_MS * tick
        for module in range(N_MODULES):
            stale = {"session": OTHER, "age_ns": 60 * NS_PER_MS} if module == 2 else {}
            planner.receive_state(module, state(module, q, tick, **stale), now_ns)
        planner.tick(now_ns)
    assert planner.status(now_ns, 0.0).mode == PlannerMode.ALIGNING


def test_once_the_other_has_ended_it_leads_in_a_new_session(planner: Planner, q: Array) -> None:
    """The modules may have retired its first one for the other's."""
    receive_all(planner, q, START_NS, session=OTHER)
    assert planner.tick(START_NS) == []
    again_ns = START_NS + AGAIN_NS + 4 * NS_PER_MS
    receive_all(planner, q, again_ns, seq=2, session=OTHER, age_ns=AGAIN_NS)
    commands = planner.tick(again_ns)
    assert {command.session for command in commands} == {SESSION + 1}
    for tick in range(3, 6):
        again_ns += 4 * NS_PER_MS
        receive_all(planner, q, again_ns, seq=tick, session=SESSION + 1)
        planner.tick(again_ns)
    assert planner.status(again_ns, 0.0).mode == PlannerMode.LEADING


def test_one_that_leads_goes_on_beside_a_module_that_another_caught(
    planner: Planner, q: Array
) -> None:
    now_ns = lead(planner, q) + 4 * NS_PER_MS
    for module in range(N_MODULES):
        caught = {"session": OTHER} if module == 1 else {}
        planner.receive_state(module, state(module, q, 9, **caught), now_ns)
    assert len(planner.tick(now_ns)) == N_MODULES


def test_what_it_knows_of_the_other_outlives_a_snapshot(
    planner: Planner, robot: RobotConfig, q: Array
) -> None:
    receive_all(planner, q, START_NS, session=OTHER)
    planner.tick(START_NS)
    successor = Planner(robot, SESSION)
    successor.restore(planner.snapshot())
    later_ns = START_NS + 100 * NS_PER_MS
    receive_all(successor, q, later_ns, seq=2, session=OTHER, age_ns=60 * NS_PER_MS)
    assert successor.tick(later_ns) == [], "half a second is not over"
