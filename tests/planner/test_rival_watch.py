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
from tests.planner.states import SESSION, START_NS, TICK_NS, lead, receive_all, receive_but

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


LATE_NS = AGE_MAX_NS + 1


@pytest.mark.parametrize(
    ("states", "own", "yields"),
    [
        pytest.param(following(*[OTHER] * 6), OWN, True, id="a newcomer"),
        pytest.param(following(*[OWN] * 5, OTHER), OWN, False, id="one who leads five"),
        pytest.param(following(*[0] * 6), OWN, False, id="modules that follow nobody"),
        pytest.param(following(OWN, OWN, age_ns=LATE_NS), OWN, False, id="its own are too old"),
        pytest.param(following(*[OTHER] * 6, age_ns=-1), OWN, False, id="no age"),
        pytest.param(following(*[OWN] * 6), OWN + 1, False, id="its own last session"),
        pytest.param(
            [*following(OWN, OWN), *following(*[OTHER] * 3, age_ns=LATE_NS)], OWN, False,
            id="one who leads and the other's are too old",
        ),
        # half a second: younger, the other may only have been held up
        pytest.param(following(*[OTHER] * 6, age_ns=AGAIN_NS), OWN, True, id="young"),
        pytest.param(following(*[OTHER] * 6, age_ns=AGAIN_NS + 1), OWN, False, id="old"),
    ],
)  # fmt: skip
def test_it_yields_to_whom_the_modules_follow(
    states: list[JointState], own: int, yields: bool
) -> None:
    rival = RivalWatch()
    rival.advance(own, states, AGE_MAX_NS)
    assert rival.yields is yields
    assert (str(OTHER) in rival.describe()) is yields


@given(st.lists(st.sampled_from([0, OWN, OTHER]), min_size=6, max_size=6))
def test_of_two_that_are_followed_exactly_one_yields(sessions: list[int]) -> None:
    one, two = watch(*sessions, own=OWN).yields, watch(*sessions, own=OTHER).yields
    assert not (one and two)
    if {OWN, OTHER} <= set(sessions):
        assert one != two


@pytest.fixture
def q(closed: Closed) -> Array:
    return closed(1.188)


def test_beside_a_leader_it_is_refused(planner: Planner, q: Array, robot: RobotConfig) -> None:
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
        now_ns = START_NS + TICK_NS * tick
        receive_but(planner, 2, q, now_ns, tick, session=OTHER, age_ns=60 * NS_PER_MS)
        planner.tick(now_ns)
    assert planner.status(now_ns, 0.0).mode == PlannerMode.ALIGNING


def test_refused_in_its_own_session_it_leads_in_a_new_one(planner: Planner, q: Array) -> None:
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
    now_ns = lead(planner, q)
    lost = {
        "session": OTHER, "age_ns": 60 * NS_PER_MS, "ready": False,
        "refusal": int(Refusal.FOREIGN_SESSION), "refused_session": SESSION,
    }  # fmt: skip
    for seq in (9, 10):  # once, and it goes on
        now_ns += TICK_NS
        receive_but(planner, 1, q, now_ns, seq, **lost)
        assert {command.session for command in planner.tick(now_ns)} == {SESSION + 1}


def test_one_that_leads_goes_on_beside_a_caught_module(planner: Planner, q: Array) -> None:
    now_ns = lead(planner, q) + TICK_NS
    receive_but(planner, 1, q, now_ns, 9, session=OTHER)
    assert len(planner.tick(now_ns)) == N_MODULES
