from __future__ import annotations

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.mcap_log.sequence_stats import KeyCount


def test_numbers_of_several_senders_tell_nothing_of_losses() -> None:
    count = KeyCount(several=True)
    for number in (1, 2, 40, 3, 41):
        count.feed(number)
    assert (count.count, count.gaps, count.missing, count.restarts) == (5, 0, 0, 0)


def test_only_keys_of_tools_have_several_senders() -> None:
    several = {key for key in topics.all_keys("lab") if topics.several_may_write(key)}
    assert several == {
        f"xrl/lab/{name}"
        for name in (
            "estop", "harness/tare", "operator/intent", "operator/hand", "sim/control", "run/event",
        )
    }  # fmt: skip


def fed(numbers: Iterable[int]) -> KeyCount:
    count = KeyCount()
    for seq in numbers:
        count.feed(seq)
    return count


def test_a_whole_sequence_has_no_gap() -> None:
    assert fed(range(100)) == KeyCount(count=100, last_seq=99)


def test_messages_before_the_first_received_one_are_not_lost() -> None:
    assert fed(range(7, 10)).missing == 0


def test_a_gap_counts_once_and_its_messages_each() -> None:
    count = fed([0, 1, 5, 6, 8])
    assert (count.gaps, count.missing, count.restarts) == (2, 4, 0)


def test_a_sequence_that_goes_back_is_a_restart_and_no_gap() -> None:
    count = fed([4, 5, 0, 1, 2])
    assert (count.gaps, count.missing, count.restarts) == (0, 0, 1)


def test_a_restart_at_the_same_number_is_seen() -> None:
    assert fed([0, 0, 0]).restarts == 2


def test_a_gap_after_a_restart_is_counted() -> None:
    count = fed([8, 9, 0, 3])
    assert (count.gaps, count.missing, count.restarts) == (1, 2, 1)


@given(st.sets(st.integers(0, 300), min_size=1))
def test_what_came_and_what_is_missing_make_the_whole(numbers: set[int]) -> None:
    count = fed(sorted(numbers))
    assert count.count + count.missing == max(numbers) - min(numbers) + 1
    assert count.restarts == 0
