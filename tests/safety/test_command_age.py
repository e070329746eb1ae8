"""The one rule of docs/architecture.md#age-rule: when is a command usable?"""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.controller import JointController
from services.joint.failsafe import RETIRED_SESSIONS_KEPT, Event, Failsafe, Timing, timing_of
from shared.bus.messages import Cause, Mode, Refusal
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import SESSION, T0, Bench, command

OTHER = 8

THIRD = 9


def taken(timing: Timing, **changes: object) -> Failsafe:
    """Return a failsafe that has taken one command, by default of age 0 at T0."""
    failsafe = Failsafe(mode=Mode.HOLD)
    assert failsafe.offer(command(**changes), T0, timing) is Refusal.NONE
    return failsafe


def test_the_limit_is_fifty_milliseconds(timing: Timing) -> None:
    assert timing.max_command_age_ns == 50 * NS_PER_MS


@pytest.mark.parametrize(
    ("off_ns", "refusal"), [(-1, Refusal.NONE), (0, Refusal.NONE), (1, Refusal.TOO_OLD)]
)
def test_a_command_is_taken_to_a_nanosecond(off_ns: int, refusal: Refusal, timing: Timing) -> None:
    sent = command(echo_t_ns=T0 - timing.max_command_age_ns - off_ns)
    assert Failsafe().offer(sent, T0, timing) is refusal


@pytest.mark.parametrize(("off_ns", "usable"), [(-1, True), (0, True), (1, False)])
def test_a_command_is_usable_to_a_nanosecond(off_ns: int, usable: bool, timing: Timing) -> None:
    failsafe = taken(timing)
    assert failsafe.is_fresh(T0 + timing.max_command_age_ns + off_ns, timing) is usable


@pytest.mark.parametrize(("off_ns", "mode"), [(-1, Mode.TRACK), (0, Mode.TRACK), (1, Mode.HOLD)])
def test_track_is_left_a_nanosecond_after(off_ns: int, mode: Mode, timing: Timing) -> None:
    failsafe = taken(timing)
    failsafe.mode = Mode.TRACK
    failsafe.fresh_since_ns = T0
    failsafe.advance(T0 + timing.max_command_age_ns + off_ns, timing, Event.NONE, estop=False)
    assert failsafe.mode is mode


@pytest.mark.parametrize(
    ("ahead_ns", "refusal"),
    [
        (0, Refusal.NONE),
        (1, Refusal.FROM_THE_FUTURE),
        (NS_PER_S, Refusal.FROM_THE_FUTURE),
        (1 << 62, Refusal.FROM_THE_FUTURE),
    ],
)
def test_a_stamp_not_given_yet_is_refused(ahead_ns: int, refusal: Refusal, timing: Timing) -> None:
    assert Failsafe().offer(command(echo_t_ns=T0 + ahead_ns), T0, timing) is refusal


def test_only_the_echoed_stamp_gives_the_age_and_not_the_planners_clock(timing: Timing) -> None:
    for t_ns in (0, T0 - NS_PER_S, T0 + 10 * NS_PER_S):
        assert Failsafe().offer(command(t_ns=t_ns), T0, timing) is Refusal.NONE


@pytest.mark.parametrize(
    ("seq", "refusal"), [(4, Refusal.NOT_NEWER), (5, Refusal.NOT_NEWER), (6, Refusal.NONE)]
)
def test_only_a_newer_sequence_is_taken(seq: int, refusal: Refusal, timing: Timing) -> None:
    failsafe = taken(timing, seq=5)
    assert failsafe.offer(command(seq=seq, echo_t_ns=T0 + 1), T0 + 2, timing) is refusal


@pytest.mark.parametrize("seconds", [1, 3, 3600])
def test_a_packet_sent_again_after_seconds_is_refused(seconds: int, timing: Timing) -> None:
    now_ns = T0 + seconds * NS_PER_S
    failsafe = taken(timing, seq=5)
    assert failsafe.offer(command(seq=5), now_ns, timing) is not Refusal.NONE
    # seconds in a stalled link: never seen before, and still too old
    assert failsafe.offer(command(seq=6), now_ns, timing) is Refusal.TOO_OLD
    assert not failsafe.is_fresh(now_ns, timing)


def test_a_foreign_session_is_refused_while_the_current_one_is_usable(timing: Timing) -> None:
    failsafe = taken(timing, seq=5)
    last_ns = T0 + timing.max_command_age_ns
    foreign = command(session=OTHER, seq=99, echo_t_ns=last_ns)
    assert failsafe.offer(foreign, last_ns, timing) is Refusal.FOREIGN_SESSION
    assert failsafe.session == SESSION


def test_a_restarted_planner_is_taken_once_the_old_session_is_stale(timing: Timing) -> None:
    failsafe = taken(timing, seq=5_000)
    now_ns = T0 + timing.max_command_age_ns + 1
    restarted = command(session=OTHER, seq=1, echo_t_ns=now_ns)
    assert failsafe.offer(restarted, now_ns, timing) is Refusal.NONE
    assert (failsafe.session, failsafe.command) == (OTHER, restarted)


def test_a_retired_session_never_comes_back(timing: Timing) -> None:
    failsafe = taken(timing)
    now_ns = T0
    for session in (OTHER, THIRD):
        now_ns += timing.max_command_age_ns + 1
        sent = command(session=session, echo_t_ns=now_ns)
        assert failsafe.offer(sent, now_ns, timing) is Refusal.NONE
    now_ns += NS_PER_S
    for session in (SESSION, OTHER):
        back = command(session=session, seq=9_999, echo_t_ns=now_ns)
        assert failsafe.offer(back, now_ns, timing) is Refusal.FOREIGN_SESSION
    assert failsafe.session == THIRD


def test_the_command_that_brings_a_new_session_must_itself_be_within_limits(timing: Timing) -> None:
    failsafe = taken(timing)
    now_ns = T0 + timing.max_command_age_ns + 1
    bad = command(session=OTHER, echo_t_ns=now_ns, k_p=(math.nan, 1.0))
    assert failsafe.offer(bad, now_ns, timing) is Refusal.OUT_OF_LIMITS
    assert failsafe.session == SESSION


def test_a_new_session_waits_for_its_own_unbroken_time_before_track(timing: Timing) -> None:
    failsafe = taken(timing)
    failsafe.fresh_since_ns = T0 - NS_PER_S
    now_ns = T0 + timing.max_command_age_ns + 1
    failsafe.offer(command(session=OTHER, echo_t_ns=now_ns), now_ns, timing)
    failsafe.advance(now_ns, timing, Event.NONE, estop=False)
    assert failsafe.mode is Mode.HOLD
    assert not failsafe.ready(now_ns + timing.engage_after_ns - 1, timing)


def test_a_new_session_never_leads_in_track_without_its_own_unbroken_time(timing: Timing) -> None:
    """Two planners run and the first dies: the second one's commands are there at once."""
    failsafe = taken(timing)
    failsafe.mode = Mode.TRACK
    failsafe.fresh_since_ns = T0 - NS_PER_S
    now_ns = T0 + timing.max_command_age_ns + 1
    assert failsafe.offer(command(session=OTHER, echo_t_ns=now_ns), now_ns, timing) is Refusal.NONE
    failsafe.advance(now_ns, timing, Event.NONE, estop=False)
    assert failsafe.mode is Mode.HOLD


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
    field: str, limit: str | None, times: float, signed: bool, axis: int, timing: Timing
) -> None:
    top = times * (getattr(timing, limit) if limit else 1.0)
    beyond = math.nextafter(top, math.inf)
    good = [0.0, top, *([-top] if signed else [])]
    bad = [beyond, math.inf, -math.inf, math.nan, -beyond if signed else -5e-324]
    for value, refusal in [(v, Refusal.NONE) for v in good] + [
        (v, Refusal.OUT_OF_LIMITS) for v in bad
    ]:
        pair = (value, 0.0) if axis == 0 else (0.0, value)
        failsafe = Failsafe()
        assert failsafe.offer(command(**{field: pair}), T0, timing) is refusal, value
        assert failsafe.refused == (refusal is not Refusal.NONE)


def test_a_refused_command_leaves_the_one_in_use_alone(timing: Timing) -> None:
    failsafe = taken(timing, seq=5)
    in_use = failsafe.command
    for bad in (
        command(seq=6, k_p=(math.nan, 0.0)),
        command(seq=4),
        command(seq=6, echo_t_ns=T0 + 1),
        command(session=OTHER, seq=6),
        command(seq=6, echo_t_ns=0),
    ):
        assert failsafe.offer(bad, T0, timing) is not Refusal.NONE
    assert failsafe.command is in_use
    assert failsafe.refused == 5


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
    robot: RobotConfig, offers: list[tuple[int, int, int, int, bool]]
) -> None:
    timing = timing_of(robot)
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


def test_a_number_far_ahead_is_refused_and_the_right_ones_after_it_are_not(timing: Timing) -> None:
    """One message with seq = 2^61 had six modules in HOLD until the planner was restarted."""
    failsafe = taken(timing, seq=10)
    assert failsafe.offer(command(seq=2**61), T0, timing) is Refusal.TOO_FAR_AHEAD
    assert failsafe.offer(command(seq=11), T0, timing) is Refusal.NONE


def test_the_step_of_a_number_may_be_500_and_not_one_more(timing: Timing) -> None:
    assert taken(timing, seq=10).offer(command(seq=510), T0, timing) is Refusal.NONE
    assert taken(timing, seq=10).offer(command(seq=511), T0, timing) is Refusal.TOO_FAR_AHEAD


@pytest.mark.parametrize("away_s", [0.0, 1.0, 60.0, 3600.0])
def test_a_planner_unheard_for_a_while_is_heard_again(timing: Timing, away_s: float) -> None:
    """It ticks on at 250 Hz, or at any rate up to 1 kHz, while its link is cut."""
    failsafe = taken(timing, seq=10)
    now_ns = T0 + round(away_s * NS_PER_S)
    told = command(seq=11 + round(1000 * away_s), echo_t_ns=now_ns)
    assert failsafe.offer(told, now_ns, timing) is Refusal.NONE


@given(ahead=st.integers(1, 2**62), away_ns=st.integers(0, 3600 * NS_PER_S))
def test_no_message_locks_a_planner_out_longer_than_away(ahead: int, away_ns: int) -> None:
    """Whatever was accepted, a planner of 250 Hz has counted beyond it soon after."""
    timing = Timing(
        max_command_age_ns=50 * NS_PER_MS, engage_after_ns=1, engage_after_max_ns=1,
        dropout_forget_ns=1, dropouts_max=1, k_p_max=1e6, k_d_max=1e6, v_max=1e6, tau_max=1e6,
    )  # fmt: skip
    failsafe = taken(timing, seq=10)
    now_ns = T0 + away_ns
    accepted = failsafe.offer(command(seq=10 + ahead, echo_t_ns=now_ns), now_ns, timing)
    if accepted is Refusal.NONE:
        assert ahead <= 500 + 2000 * away_ns / NS_PER_S
    else:
        assert accepted is Refusal.TOO_FAR_AHEAD
        assert failsafe.offer(command(seq=11, echo_t_ns=now_ns), now_ns, timing) is Refusal.NONE


def test_the_newest_refusal_is_told_for_a_second_and_of_whom_it_came(timing: Timing) -> None:
    failsafe = taken(timing, seq=10)
    assert failsafe.newest_refusal(T0) == (Refusal.NONE, 0)
    failsafe.offer(command(session=OTHER, seq=11), T0, timing)
    assert failsafe.newest_refusal(T0 + NS_PER_S) == (Refusal.FOREIGN_SESSION, OTHER)
    assert failsafe.newest_refusal(T0 + NS_PER_S + 1) == (Refusal.NONE, 0)


def test_commands_from_before_the_drive_was_armed_do_not_count(timing: Timing) -> None:
    failsafe, now_ns = Failsafe(), T0
    for seq in range(1000):
        now_ns += 2 * NS_PER_MS
        failsafe.offer(command(seq=seq, echo_t_ns=now_ns), now_ns, timing)
        failsafe.advance(now_ns, timing, Event.NONE, estop=False)
    assert failsafe.fresh_since_ns == -1
    failsafe.advance(now_ns, timing, Event.DRIVE_ARMED, estop=False)
    armed_ns, seq = now_ns, 1000
    while failsafe.mode is not Mode.TRACK:
        assert failsafe.mode is Mode.HOLD
        now_ns, seq = now_ns + 2 * NS_PER_MS, seq + 1
        failsafe.offer(command(seq=seq, echo_t_ns=now_ns), now_ns, timing)
        failsafe.advance(now_ns, timing, Event.NONE, estop=False)
    assert now_ns - armed_ns >= timing.engage_after_ns


@pytest.mark.parametrize(("age_ms", "taken"), [(49, True), (51, False)])
def test_a_drive_is_taken_over_on_the_commands_gains_only_while_the_command_is_usable(
    robot: RobotConfig, age_ms: int, *, taken: bool
) -> None:
    controller = JointController(believing(robot), "knee_right")
    bench = Bench(robot)
    told = command(hold=True, k_p=(600.0, 12.0), k_d=(40.0, 3.0), echo_t_ns=T0)
    controller.failsafe.offer(told, T0, controller.timing)
    bench.now_ns = T0 + age_ms * NS_PER_MS
    reading = msgspec.structs.replace(bench.reading(), torque=(1.0, -1.0))
    controller.step(bench.now_ns, reading, None, estop=False)
    assert controller.failsafe.mode is Mode.HOLD
    assert (controller.setpoint.k_p == told.k_p) is taken


def test_a_clock_that_starts_at_nought_is_a_clock(timing: Timing) -> None:
    failsafe = Failsafe(mode=Mode.HOLD, fresh_since_ns=0)
    assert failsafe.ready(timing.engage_after_ns, timing)
    assert not failsafe.ready(timing.engage_after_ns - 1, timing)


def test_the_last_256_sessions_never_become_current_again(timing: Timing) -> None:
    failsafe, now_ns = Failsafe(), T0
    for session in range(1, RETIRED_SESSIONS_KEPT + 4):
        now_ns += timing.max_command_age_ns + 1
        told = command(session=session, echo_t_ns=now_ns)
        assert failsafe.offer(told, now_ns, timing) is Refusal.NONE
    assert failsafe.retired == tuple(range(3, RETIRED_SESSIONS_KEPT + 3))


def test_the_failsafes_times_and_limits_are_the_robot_files(robot: RobotConfig) -> None:
    service = robot.joint_service
    assert timing_of(robot) == Timing(
        max_command_age_ns=round(1e6 * service.max_command_age_ms),
        engage_after_ns=round(1e6 * service.engage_after_ms),
        engage_after_max_ns=round(1e6 * service.engage_after_max_ms),
        dropout_forget_ns=round(1e9 * service.dropout_forget_s),
        dropouts_max=5,  # 100 ms, doubled five times, are the 3.2 s at most
        k_p_max=service.k_p_max,
        k_d_max=service.k_d_max,
        v_max=service.v_max,
        tau_max=4.0 * robot.joint.tau_module_max,
    )


def test_at_the_first_instant_of_a_clock_commands_are_fresh_as_at_any_other(timing: Timing) -> None:
    failsafe = Failsafe(mode=Mode.HOLD)
    for seq in range(3):
        failsafe.offer(command(seq=seq, echo_t_ns=seq), seq, timing)
        failsafe.advance(seq, timing, Event.NONE, estop=False)
        assert failsafe.fresh_since_ns == 0
    tracking = Failsafe(mode=Mode.TRACK, session=SESSION, fresh_since_ns=0)
    tracking.offer(command(echo_t_ns=1), 1, timing)
    assert tracking.advance(1, timing, Event.NONE, estop=False) is not Cause.COMMAND_STALE


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("session", [SESSION, OTHER])
def test_a_planner_whose_process_ended_is_tracked_no_more_and_counts_anew(
    mode: Mode, session: int, timing: Timing
) -> None:
    failsafe = taken(timing)
    failsafe.mode, failsafe.fresh_since_ns = mode, T0 - 10 * timing.engage_after_max_ns
    failsafe.end_session(session)
    cause = failsafe.advance(T0, timing, Event.NONE, estop=False)
    if session == OTHER:
        assert cause == (Cause.COMMANDS_FRESH if mode is Mode.HOLD else None)
    elif mode is Mode.TRACK:
        assert (failsafe.mode, cause) == (Mode.HOLD, Cause.PLANNER_ENDED)
        assert failsafe.dropouts.count == 1
        assert not failsafe.planner_ended, "the next drop-out has a cause of its own"
    else:
        assert (failsafe.mode, cause) == (mode, None)
    if session == SESSION and mode in (Mode.HOLD, Mode.TRACK):  # by what was on its way to it
        after_ns = failsafe.engage_after_ns(timing)
        late = command(seq=2, echo_t_ns=T0 + after_ns)
        assert failsafe.offer(late, T0 + after_ns, timing) is Refusal.NONE
        failsafe.advance(T0 + 1, timing, Event.NONE, estop=False)
        assert not failsafe.ready(T0 + after_ns - 1, timing)
