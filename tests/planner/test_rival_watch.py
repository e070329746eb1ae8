"""Two planners by accident: whoever is followed leads on, the other waits and says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.failsafe import Failsafe, timing_of
from services.planner.planner import Planner
from services.planner.watch.rival_watch import AGAIN_NS, RivalWatch
from shared.bus.messages import JointState, PlannerMode, Refusal
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.joints import N_MODULES
from tests.planner.conftest import Closed
from tests.planner.oracle import Array
from tests.planner.test_planner import SESSION, START_NS, lead, receive_all, state

OWN, OTHER = 7, 9
AGE_MAX_NS = 50 * NS_PER_MS


def following(*sessions: int, age_ns: int = 2 * NS_PER_MS) -> list[JointState]:
    return cast(
        "list[JointState]",
        [
            SimpleNamespace(session=session, age_ns=age_ns, refusal=0, refused_session=0)
            for session in sessions
        ],
    )


def watch(*sessions: int, own: int = OWN, age_ns: int = 2 * NS_PER_MS) -> RivalWatch:
    rival = RivalWatch()
    rival.advance(own, following(*sessions, age_ns=age_ns), AGE_MAX_NS)
    return rival


def test_a_newcomer_yields_to_whom_the_modules_follow() -> None:
    rival = watch(*[OTHER] * 6)
    assert rival.yields
    assert str(OTHER) in rival.describe()


def test_one_who_leads_does_not_yield_to_a_newcomer_that_caught_a_module() -> None:
    assert not watch(OWN, OWN, OWN, OWN, OWN, OTHER).yields


def test_modules_that_follow_nobody_or_whose_command_is_too_old_make_no_rival() -> None:
    assert not watch(*[0] * 6).yields
    assert not watch(*[OTHER] * 6, age_ns=AGAIN_NS + 1).yields
    assert not watch(OWN, OWN, age_ns=AGE_MAX_NS + 1).yields
    assert not watch(*[OTHER] * 6, age_ns=-1).yields


@given(st.lists(st.sampled_from([0, OWN, OTHER]), min_size=6, max_size=6))
def test_of_two_planners_never_both_yield_and_never_both_go_on_while_both_are_followed(
    sessions: list[int],
) -> None:
    one, two = watch(*sessions, own=OWN).yields, watch(*sessions, own=OTHER).yields
    assert not (one and two)
    if {OWN, OTHER} <= set(sessions):
        assert one != two


def test_it_goes_on_when_the_others_command_is_half_a_second_old() -> None:
    """Younger, the other may only have been held up: also for one that has just started."""
    assert watch(*[OTHER] * 6, age_ns=AGAIN_NS).yields
    rival = watch(*[OTHER] * 6, age_ns=AGAIN_NS + 1)
    assert not rival.yields
    assert rival.describe() == ""


def test_one_who_leads_waits_for_nobody_whose_command_is_too_old() -> None:
    states = [*following(OWN, OWN), *following(OTHER, OTHER, OTHER, age_ns=AGE_MAX_NS + 1)]
    rival = RivalWatch()
    rival.advance(OWN, states, AGE_MAX_NS)
    assert not rival.yields


def test_modules_that_still_follow_ones_last_session_are_no_rivals() -> None:
    assert not watch(*[OWN] * 6, own=OWN + 1).yields


@pytest.fixture
def planner(robot: RobotConfig) -> Planner:
    return Planner(robot, SESSION)


@pytest.fixture
def q(closed: Closed) -> Array:
    return closed(1.188)


def test_a_planner_beside_one_that_leads_is_refused_by_each_module_and_says_why(
    planner: Planner, q: Array, robot: RobotConfig
) -> None:
    timing = timing_of(robot)
    told = 0
    for tick in range(200):
        now_ns = START_NS + 4 * NS_PER_MS * tick
        receive_all(planner, q, now_ns, seq=tick, session=OTHER)
        for command in planner.tick(now_ns):
            told += 1
            beside = msgspec.structs.replace(command, session=OTHER, echo_t_ns=now_ns)
            led, alone = Failsafe(session=OTHER, command=beside), Failsafe()
            assert led.offer(command, now_ns, timing) is Refusal.FOREIGN_SESSION
            assert alone.offer(command, now_ns, timing) is Refusal.TOO_OLD
    assert told == 4 * N_MODULES, "five times a second"
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


def test_once_the_other_has_ended_it_leads_and_in_a_new_session_if_its_own_is_refused(
    planner: Planner, q: Array
) -> None:
    """The modules retired its session for the other's while it was held up."""
    receive_all(planner, q, START_NS, session=OTHER)
    assert all(command.echo_t_ns < START_NS - AGE_MAX_NS for command in planner.tick(START_NS))
    now_ns = START_NS + AGAIN_NS
    receive_all(planner, q, now_ns, seq=2, session=OTHER, age_ns=AGAIN_NS + 1)
    assert {command.session for command in planner.tick(now_ns)} == {SESSION}
    refused = {"refusal": int(Refusal.FOREIGN_SESSION), "refused_session": SESSION}
    now_ns += 4 * NS_PER_MS
    receive_all(planner, q, now_ns, seq=3, session=OTHER, age_ns=2 * AGAIN_NS, **refused)
    assert {command.session for command in planner.tick(now_ns)} == {SESSION + 1}
    for tick in range(4, 8):
        now_ns += 4 * NS_PER_MS
        receive_all(planner, q, now_ns, seq=tick, session=SESSION + 1, **refused)
        planner.tick(now_ns)
    status = planner.status(now_ns, 0.0)
    assert (status.mode, status.session) == (PlannerMode.LEADING, SESSION + 1)


def test_one_module_that_has_retired_its_session_is_regained(planner: Planner, q: Array) -> None:
    now_ns = lead(planner, q) + 4 * NS_PER_MS
    lost = {
        "session": OTHER, "age_ns": 60 * NS_PER_MS, "ready": False,
        "refusal": int(Refusal.FOREIGN_SESSION), "refused_session": SESSION,
    }  # fmt: skip
    for module in range(N_MODULES):
        planner.receive_state(module, state(module, q, 9, **(lost if module == 1 else {})), now_ns)
    assert {command.session for command in planner.tick(now_ns)} == {SESSION + 1}
    now_ns += 4 * NS_PER_MS
    for module in range(N_MODULES):
        planner.receive_state(module, state(module, q, 10, **(lost if module == 1 else {})), now_ns)
    commands = planner.tick(now_ns)
    assert {command.session for command in commands} == {SESSION + 1}, "once, and it goes on"


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
    receive_all(successor, q, later_ns, seq=2, session=OTHER, age_ns=AGAIN_NS + 1)
    assert len(successor.tick(later_ns)) == N_MODULES
    assert str(OTHER) not in successor.status(later_ns, 0.0).why
