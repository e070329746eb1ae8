from __future__ import annotations

from collections.abc import Iterable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.mcap_log.sequence_stats import KeyCount


def fed(numbers: Iterable[int], *, several: bool = False) -> KeyCount:
    count = KeyCount(several=several)
    for seq in numbers:
        count.feed(seq)
    return count


CASES = {
    "a whole sequence has no gap": (range(100), 0, 0, 0),
    "what was before the first received one is not lost": (range(7, 10), 0, 0, 0),
    "a gap counts once and its messages each": ([0, 1, 5, 6, 8], 2, 4, 0),
    "one that goes back is a restart and no gap": ([4, 5, 0, 1, 2], 0, 0, 1),
    "a restart at the same number is seen": ([0, 0, 0], 0, 0, 2),
    "a gap after a restart is counted": ([8, 9, 0, 3], 1, 2, 1),
}


@pytest.mark.parametrize(("numbers", "gaps", "missing", "restarts"), CASES.values(), ids=CASES)
def test_losses_are_counted_by_the_numbers_of_one_sender(
    numbers: Sequence[int], gaps: int, missing: int, restarts: int
) -> None:
    expected = KeyCount(
        count=len(numbers), gaps=gaps, missing=missing, restarts=restarts, last_seq=numbers[-1]
    )
    assert fed(numbers) == expected


def test_numbers_of_several_senders_tell_nothing_of_losses_and_only_tools_are_several() -> None:
    count = fed((1, 2, 40, 3, 41), several=True)
    assert (count.count, count.gaps, count.missing, count.restarts) == (5, 0, 0, 0)
    several = {key for key in topics.all_keys("lab") if topics.several_may_write(key)}
    assert several == {
        f"xrl/lab/{name}"
        for name in (
            "estop", "harness/tare", "operator/intent", "operator/hand", "sim/control", "run/event",
        )
    }  # fmt: skip


@given(st.sets(st.integers(0, 300), min_size=1))
def test_what_came_and_what_is_missing_make_the_whole(numbers: set[int]) -> None:
    count = fed(sorted(numbers))
    assert count.count + count.missing == max(numbers) - min(numbers) + 1
    assert count.restarts == 0
