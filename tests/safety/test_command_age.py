"""The one rule of docs/architecture.md#age-rule: when is a command usable?"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.failsafe import RETIRED_SESSIONS_KEPT, Event, Failsafe, Timing, timing_of
from shared.bus.messages import Cause, Mode, Refusal
from shared.clock import NS_PER_MS, NS_PER_S
from tests.joint.helpers import SESSION, T0, TIMING, Bench, command
from tests.robots import ROBOT

OTHER = 8
AGE_NS = 50 * NS_PER_MS
"""Maximum age of a command."""


def taken(**changes: object) -> Failsafe:
    """Return a failsafe that has taken one command, by default of age 0 at T0."""
    failsafe = Failsafe(mode=Mode.HOLD)
    assert failsafe.offer(command(**changes), T0, TIMING) is Refusal.NONE
    return failsafe


class Offer(NamedTuple):
    """A command that is offered some time after T0, of an age, with some fields changed."""

    refusal: Refusal
    age_ns: int = 0
    after_ns: int = 0
    told: dict[str, Any] = {}  # noqa: RUF012 - never changed


FIRST = {
    "as old as it may be": Offer(Refusal.NONE, AGE_NS),
    "a nanosecond younger": Offer(Refusal.NONE, AGE_NS - 1),
    "a nanosecond too old": Offer(Refusal.TOO_OLD, AGE_NS + 1),
    "a nanosecond ahead": Offer(Refusal.FROM_THE_FUTURE, -1),
    "a second ahead": Offer(Refusal.FROM_THE_FUTURE, -NS_PER_S),
    "a century ahead": Offer(Refusal.FROM_THE_FUTURE, -(1 << 62)),
    **{f"a planner's clock at {t_ns} ns": Offer(Refusal.NONE, told={"t_ns": t_ns})
       for t_ns in (0, T0 - NS_PER_S, T0 + 10 * NS_PER_S)},
}  # fmt: skip
"""Offered before any other: only the echoed stamp gives the age."""

LATER = {
    "an older number": Offer(Refusal.NOT_NEWER, 1, 2, {"seq": 9}),
    "the same number": Offer(Refusal.NOT_NEWER, 1, 2, {"seq": 10}),
    "the next number": Offer(Refusal.NONE, 1, 2, {"seq": 11}),
    "not a number": Offer(Refusal.OUT_OF_LIMITS, 0, 0, {"seq": 11, "k_p": (math.nan, 0.0)}),
    "the farthest number ahead": Offer(Refusal.NONE, 0, 0, {"seq": 510}),
    "one too far ahead": Offer(Refusal.TOO_FAR_AHEAD, 0, 0, {"seq": 511}),
    # one such message had six modules in HOLD until the planner was restarted
    "a number far ahead": Offer(Refusal.TOO_FAR_AHEAD, 0, 0, {"seq": 2**61}),
    # a planner unheard for a while ticks on, at up to 1 kHz
    **{f"unheard for {s} s": Offer(Refusal.NONE, 0, s * NS_PER_S, {"seq": 11 + 1000 * s})
       for s in (1, 60, 3600)},
    "another session, the last usable": Offer(
        Refusal.FOREIGN_SESSION, 0, AGE_NS, {"session": OTHER, "seq": 99}
    ),
    "another session, the last stale": Offer(
        Refusal.NONE, 0, AGE_NS + 1, {"session": OTHER, "seq": 1}
    ),
    "another session beyond limits": Offer(
        Refusal.OUT_OF_LIMITS, 0, AGE_NS + 1, {"session": OTHER, "k_p": (math.nan, 1.0)}
    ),
}  # fmt: skip
"""Offered after number 10 was taken."""


@pytest.mark.parametrize("offer", [*FIRST, *LATER])
def test_a_command_is_taken_by_its_age_number_and_session_or_leaves_the_one_in_use(
    offer: str,
) -> None:
    refusal, age_ns, after_ns, told = (FIRST | LATER)[offer]
    failsafe = taken(seq=10) if offer in LATER else Failsafe()
    before, now_ns = (failsafe.command, failsafe.session), T0 + after_ns
    sent = command(echo_t_ns=now_ns - age_ns, **told)
    assert failsafe.offer(sent, now_ns, TIMING) is refusal
    taken_now = refusal is Refusal.NONE
    expected = (sent, sent.session) if taken_now else before
    assert (failsafe.command, failsafe.session) == expected
    assert failsafe.refused == (not taken_now)


@pytest.mark.parametrize(("off_ns", "usable"), [(-1, True), (0, True), (1, False)])
def test_a_command_is_usable_and_tracked_to_a_nanosecond(off_ns: int, usable: bool) -> None:
    failsafe, now_ns = taken(), T0 + AGE_NS + off_ns
    assert failsafe.is_fresh(now_ns, TIMING) is usable
    failsafe.mode, failsafe.fresh_since_ns = Mode.TRACK, T0
    failsafe.advance(now_ns, TIMING, Event.NONE, estop=False)
    assert failsafe.mode is (Mode.TRACK if usable else Mode.HOLD)


@pytest.mark.parametrize("seconds", [1, 3, 3600])
def test_a_packet_sent_again_after_seconds_is_refused(seconds: int) -> None:
    now_ns = T0 + seconds * NS_PER_S
    failsafe = taken(seq=5)
    for seq in (5, 6):  # the second was seconds in a stalled link: never seen before
        assert failsafe.offer(command(seq=seq), now_ns, TIMING) is Refusal.TOO_OLD
    assert not failsafe.is_fresh(now_ns, TIMING)


def test_a_retired_session_never_comes_back() -> None:
    """Not while the last 256 are remembered."""
    failsafe, now_ns = Failsafe(), T0
    for session in range(1, RETIRED_SESSIONS_KEPT + 4):
        now_ns += AGE_NS + 1
        told = command(session=session, echo_t_ns=now_ns)
        assert failsafe.offer(told, now_ns, TIMING) is Refusal.NONE
    assert failsafe.retired == tuple(range(3, RETIRED_SESSIONS_KEPT + 3))
    now_ns += NS_PER_S
    for session in (3, RETIRED_SESSIONS_KEPT + 2):
        back = command(session=session, seq=9_999, echo_t_ns=now_ns)
        assert failsafe.offer(back, now_ns, TIMING) is Refusal.FOREIGN_SESSION


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.TRACK])
def test_a_new_session_never_leads_without_its_own_unbroken_time(mode: Mode) -> None:
    """Two planners run and the first dies: the second one's commands are there at once."""
    failsafe = taken()
    failsafe.mode, failsafe.fresh_since_ns = mode, T0 - NS_PER_S
    now_ns = T0 + AGE_NS + 1
    assert failsafe.offer(command(session=OTHER, echo_t_ns=now_ns), now_ns, TIMING) is Refusal.NONE
    failsafe.advance(now_ns, TIMING, Event.NONE, estop=False)
    assert failsafe.mode is Mode.HOLD
    assert not failsafe.ready(now_ns + TIMING.engage_after_ns - 1, TIMING)


# field; the limit it goes up to, by its name in Timing, and times how much; may it be negative?
LIMITS = [
    ("q_ref", None, 6.4, True),
    ("v_ref", "v_max", 1.0, True),
    ("tau_ff", "tau_max", 1.0, True),
    ("dtau_ff", "tau_max", 1e3, True),
    ("tau_coupled", "tau_max", 1.0, True),
    ("k_p", "k_p_max", 1.0, False),
    ("k_d", "k_d_max", 1.0, False),
]


def test_every_number_of_the_law_is_on_the_list_of_limits() -> None:
    sent = command()
    pairs = {name for name in sent.__struct_fields__ if isinstance(getattr(sent, name), tuple)}
    assert pairs == {row[0] for row in LIMITS}


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("field", "limit", "times", "signed"), LIMITS)
def test_each_field_is_taken_up_to_its_limit_and_refused_beyond(
    field: str, limit: str | None, times: float, signed: bool, axis: int
) -> None:
    top = times * (getattr(TIMING, limit) if limit else 1.0)
    beyond = math.nextafter(top, math.inf)
    good = [0.0, top, *([-top] if signed else [])]
    bad = [beyond, math.inf, -math.inf, math.nan, -beyond if signed else -5e-324]
    for values, refusal in ((good, Refusal.NONE), (bad, Refusal.OUT_OF_LIMITS)):
        for value in values:
            pair = (value, 0.0) if axis == 0 else (0.0, value)
            assert Failsafe().offer(command(**{field: pair}), T0, TIMING) is refusal, value


@given(
    offers=st.lists(
        st.tuples(
            st.integers(0, 40 * NS_PER_MS),  # time since the last offer
            st.integers(-5 * NS_PER_MS, 120 * NS_PER_MS),  # age
            st.integers(1, 3),  # session
            st.integers(0, 6),  # sequence
            st.booleans(),  # within limits
        ),
        max_size=40,
    )
)
def test_whatever_is_in_use_met_the_whole_rule_when_it_was_taken(
    offers: list[tuple[int, int, int, int, bool]],
) -> None:
    timing = TIMING
    failsafe, now_ns, retired = Failsafe(), T0, set[int]()
    for wait_ns, age_ns, session, seq, good in offers:
        now_ns += wait_ns
        before, current = failsafe.command, failsafe.session
        was_usable = failsafe.is_fresh(now_ns, timing)
        k_p = (1.0, 1.0) if good else (1.0, math.inf)
        sent = command(echo_t_ns=now_ns - age_ns, session=session, seq=seq, k_p=k_p)
        rule = 0 <= age_ns <= timing.max_command_age_ns and good and session not in retired
        if before is not None and session == current:
            rule = rule and seq > before.seq
        elif before is not None:
            rule = rule and not was_usable
        assert (failsafe.offer(sent, now_ns, timing) is Refusal.NONE) is rule
        assert failsafe.command is (sent if rule else before)
        if rule and before is not None and session != current:
            retired.add(current)


@given(ahead=st.integers(1, 2**62), away_ns=st.integers(0, 3600 * NS_PER_S))
def test_no_message_locks_a_planner_out_longer_than_away(ahead: int, away_ns: int) -> None:
    """Whatever was accepted, a planner of 250 Hz has counted beyond it soon after."""
    timing, now_ns = TIMING, T0 + away_ns
    failsafe = taken(seq=10)
    accepted = failsafe.offer(command(seq=10 + ahead, echo_t_ns=now_ns), now_ns, timing)
    if accepted is Refusal.NONE:
        assert ahead <= 500 + 2000 * away_ns / NS_PER_S
    else:
        assert accepted is Refusal.TOO_FAR_AHEAD
        assert failsafe.offer(command(seq=11, echo_t_ns=now_ns), now_ns, timing) is Refusal.NONE


def test_the_newest_refusal_is_told_for_a_second_and_of_whom_it_came() -> None:
    failsafe = taken(seq=10)
    assert failsafe.newest_refusal(T0) == (Refusal.NONE, 0)
    failsafe.offer(command(session=OTHER, seq=11), T0, TIMING)
    assert failsafe.newest_refusal(T0 + NS_PER_S) == (Refusal.FOREIGN_SESSION, OTHER)
    assert failsafe.newest_refusal(T0 + NS_PER_S + 1) == (Refusal.NONE, 0)


def test_commands_from_before_the_drive_was_armed_do_not_count() -> None:
    failsafe, now_ns = Failsafe(), T0
    for seq in range(1000):
        now_ns += 2 * NS_PER_MS
        failsafe.offer(command(seq=seq, echo_t_ns=now_ns), now_ns, TIMING)
        failsafe.advance(now_ns, TIMING, Event.NONE, estop=False)
    assert failsafe.fresh_since_ns == -1
    failsafe.advance(now_ns, TIMING, Event.DRIVE_ARMED, estop=False)
    armed_ns, seq = now_ns, 1000
    while failsafe.mode is not Mode.TRACK:
        assert failsafe.mode is Mode.HOLD
        now_ns, seq = now_ns + 2 * NS_PER_MS, seq + 1
        failsafe.offer(command(seq=seq, echo_t_ns=now_ns), now_ns, TIMING)
        failsafe.advance(now_ns, TIMING, Event.NONE, estop=False)
    assert now_ns - armed_ns >= TIMING.engage_after_ns


@pytest.mark.parametrize(("age_ms", "taken"), [(49, True), (51, False)])
def test_a_drive_is_taken_over_on_the_commands_gains_only_while_the_command_is_usable(
    age_ms: int, *, taken: bool
) -> None:
    bench = Bench(ROBOT)
    told = command(hold=True, k_p=(600.0, 12.0), k_d=(40.0, 3.0), echo_t_ns=T0)
    bench.controller.failsafe.offer(told, T0, bench.law.timing)
    bench.now_ns = T0 + age_ms * NS_PER_MS
    reading = msgspec.structs.replace(bench.reading(), torque=(1.0, -1.0))
    bench.law.step(bench.controller, bench.now_ns, reading, None, estop=False)
    assert bench.mode is Mode.HOLD
    assert (bench.controller.law.current.k_p == told.k_p) is taken


def test_the_failsafes_times_and_limits_are_the_robot_files() -> None:
    service = ROBOT.joint_service
    assert timing_of(ROBOT) == Timing(
        max_command_age_ns=AGE_NS,
        engage_after_ns=round(1e6 * service.engage_after_ms),
        engage_after_max_ns=round(1e6 * service.engage_after_max_ms),
        dropout_forget_ns=round(1e9 * service.dropout_forget_s),
        dropouts_max=5,  # 100 ms, doubled five times, are the 3.2 s at most
        k_p_max=service.k_p_max,
        k_d_max=service.k_d_max,
        v_max=service.v_max,
        tau_max=4.0 * ROBOT.joint.tau_module_max,
    )
    assert service.max_command_age_ms == 50.0


def test_at_the_first_instant_of_a_clock_commands_are_fresh_as_at_any_other() -> None:
    failsafe = Failsafe(mode=Mode.HOLD)
    for seq in range(3):
        failsafe.offer(command(seq=seq, echo_t_ns=seq), seq, TIMING)
        failsafe.advance(seq, TIMING, Event.NONE, estop=False)
        assert failsafe.fresh_since_ns == 0
    assert failsafe.ready(TIMING.engage_after_ns, TIMING)
    assert not failsafe.ready(TIMING.engage_after_ns - 1, TIMING)
    tracking = Failsafe(mode=Mode.TRACK, session=SESSION, fresh_since_ns=0)
    tracking.offer(command(echo_t_ns=1), 1, TIMING)
    assert tracking.advance(1, TIMING, Event.NONE, estop=False) is not Cause.COMMAND_STALE


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("session", [SESSION, OTHER])
def test_a_planner_whose_process_ended_is_tracked_no_more_and_counts_anew(
    mode: Mode, session: int
) -> None:
    failsafe = taken()
    failsafe.mode, failsafe.fresh_since_ns = mode, T0 - 10 * TIMING.engage_after_max_ns
    failsafe.end_session(session)
    cause = failsafe.advance(T0, TIMING, Event.NONE, estop=False)
    if session == OTHER:
        assert cause == (Cause.COMMANDS_FRESH if mode is Mode.HOLD else None)
    elif mode is Mode.TRACK:
        assert (failsafe.mode, cause) == (Mode.HOLD, Cause.PLANNER_ENDED)
        assert failsafe.dropouts.count == 1
        assert not failsafe.planner_ended, "the next drop-out has a cause of its own"
    else:
        assert (failsafe.mode, cause) == (mode, None)
    if session == SESSION and mode in (Mode.HOLD, Mode.TRACK):  # by what was on its way to it
        after_ns = failsafe.engage_after_ns(TIMING)
        late = command(seq=2, echo_t_ns=T0 + after_ns)
        assert failsafe.offer(late, T0 + after_ns, TIMING) is Refusal.NONE
        failsafe.advance(T0 + 1, TIMING, Event.NONE, estop=False)
        assert not failsafe.ready(T0 + after_ns - 1, TIMING)
