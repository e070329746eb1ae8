"""When which message goes out, in virtual time."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from shared.clock import NS_PER_MS, NS_PER_S
from tools.logs.playback.schedule import (
    PASS_MIN_NS,
    RATE_MAX,
    RATE_MIN,
    Entry,
    EntryStream,
    Playhead,
    Schedule,
    Window,
    window,
)


def schedule_of(rows: Sequence[Entry], part: Window, *, loop: bool) -> Schedule:
    """Return a schedule that reads its messages in blocks of a second."""
    stream = EntryStream(
        lambda begin_ns, end_ns: [row for row in rows if begin_ns <= row.time_ns < end_ns],
        part,
        block_ns=NS_PER_S,
    )
    return Schedule(stream, part, loop=loop)


BEGAN = 7_000_000_000_000
TIMES = st.lists(st.integers(0, 5 * NS_PER_S), min_size=1, max_size=40).map(sorted)
RATES = st.floats(RATE_MIN, RATE_MAX)


def entries(times: list[int]) -> list[Entry]:
    return [Entry(BEGAN + t, n % 3, b"%d" % n) for n, t in enumerate(times)]


def played(schedule: Schedule, at_most: int = 1000) -> list[tuple[int, bytes]]:
    found: list[tuple[int, bytes]] = []
    while len(found) < at_most and (position := schedule.next_ns()) is not None:
        found.append((position, schedule.pop().payload))
    return found


def whole(rows: list[Entry]) -> Window:
    return window(rows[0].time_ns, rows[-1].time_ns, 0, None)


@given(TIMES)
def test_without_a_window_every_message_is_played_once_and_in_order(times: list[int]) -> None:
    rows = entries(times)
    found = played(schedule_of(rows, whole(rows), loop=False))
    assert [payload for _, payload in found] == [row.payload for row in rows]
    assert [position for position, _ in found] == [t - times[0] for t in times]


@given(TIMES, st.lists(st.integers(1, 3 * NS_PER_S), max_size=6))
def test_windows_that_follow_one_another_hold_every_message_once(
    times: list[int], durations: list[int]
) -> None:
    rows = entries(times)
    offset, found = 0, list[bytes]()
    for duration in (*durations, None):
        part = window(rows[0].time_ns, rows[-1].time_ns, offset, duration)
        found += [payload for _, payload in played(schedule_of(rows, part, loop=False))]
        offset += duration or 0
    assert found == [row.payload for row in rows]


def test_a_window_has_its_first_moment_and_not_its_last() -> None:
    rows = entries([0, 10, 20, 30])
    part = window(BEGAN, BEGAN + 30, 10, 20)
    assert played(schedule_of(rows, part, loop=False)) == [(0, b"1"), (10, b"2")]


def test_a_window_behind_the_log_is_empty() -> None:
    rows = entries([0, 10])
    assert played(schedule_of(rows, window(BEGAN, BEGAN + 10, 11, None), loop=True)) == []


@given(TIMES, st.integers(2, 4))
def test_a_loop_repeats_the_pass_at_one_spacing(times: list[int], passes: int) -> None:
    rows = entries(times)
    schedule = schedule_of(rows, whole(rows), loop=True)
    found = played(schedule, passes * len(rows))
    period = max(schedule.length_ns, PASS_MIN_NS)
    for number, (position, payload) in enumerate(found):
        turn, index = divmod(number, len(rows))
        assert payload == rows[index].payload
        assert position == turn * period + times[index] - times[0]
    assert schedule.passes == passes - 1


def test_a_log_of_one_message_is_not_looped_without_a_pause() -> None:
    rows = entries([0])
    positions = [position for position, _ in played(schedule_of(rows, whole(rows), loop=True), 3)]
    assert positions == [0, PASS_MIN_NS, 2 * PASS_MIN_NS]


def test_the_recorded_time_goes_on_to_the_windows_end_and_begins_anew_in_a_loop() -> None:
    rows = entries([0, NS_PER_S])
    part = window(BEGAN, BEGAN + NS_PER_S, 0, None)
    once, looped = (schedule_of(rows, part, loop=loop) for loop in (False, True))
    for schedule in (once, looped):
        assert schedule.recorded_ns(NS_PER_S // 2) == BEGAN + NS_PER_S // 2
    assert once.recorded_ns(5 * NS_PER_S) == BEGAN + NS_PER_S + 1
    assert looped.recorded_ns(looped.length_ns + 7) == BEGAN + 7


@given(RATES, st.lists(st.integers(0, 3_600 * NS_PER_S), min_size=1))
def test_a_moment_is_reached_when_it_is_due_and_not_before(
    rate: float, positions: list[int]
) -> None:
    head = Playhead(BEGAN, rate)
    for position in positions:
        due = head.due_ns(position)
        assert due is not None
        # ns to position and back: within what a double holds of an hour
        slack = 2 + round(rate)
        assert head.position(due + 2) >= position - slack
        assert head.position(due - 2) <= position + slack
        assert abs(due - BEGAN - position / rate) <= 2 + position / rate * 1e-12


@given(st.lists(st.integers(1, NS_PER_S), min_size=1, max_size=50))
def test_no_error_adds_up_however_often_one_looks(steps: list[int]) -> None:
    looked, unlooked = Playhead(BEGAN, 1 / 3), Playhead(BEGAN, 1 / 3)
    now = BEGAN
    for step in steps:
        now += step
        looked.position(now)
        looked.due_ns(step)
    assert looked.position(now) == unlooked.position(now)


@given(st.lists(st.tuples(st.integers(0, NS_PER_S), st.integers(0, NS_PER_S)), max_size=20))
def test_pauses_are_left_out_of_the_time_played(spells: list[tuple[int, int]]) -> None:
    head = Playhead(BEGAN, 1.0)
    now = BEGAN
    for running, paused in spells:
        now += running
        head.pause(now)
        assert head.due_ns(10**15) is None
        now += paused
        head.resume(now)
    assert head.position(now) == sum(running for running, _ in spells)


def test_a_change_of_rate_keeps_the_position() -> None:
    head = Playhead(0, 2.0)
    head.change_rate(NS_PER_S, 0.5)
    assert head.position(NS_PER_S) == 2 * NS_PER_S
    assert head.position(3 * NS_PER_S) == 3 * NS_PER_S
    assert head.due_ns(3 * NS_PER_S) == 3 * NS_PER_S
    head.change_rate(3 * NS_PER_S, 1e9)
    assert head.rate == RATE_MAX


def test_a_step_goes_forward_only() -> None:
    head = Playhead(0, 1.0, paused=True)
    head.step(5 * NS_PER_MS)
    head.step(3 * NS_PER_MS)
    assert head.position(NS_PER_S) == 5 * NS_PER_MS
