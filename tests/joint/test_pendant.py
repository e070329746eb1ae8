"""When a pendant is lost: a rule for each joint service."""

from __future__ import annotations

from services.joint.pendant import PendantWatch
from shared.clock import NS_PER_MS


def silent(watch: PendantWatch, beats: int, from_ns: int, cycles: int) -> int:
    """Run cycles of 2 ms with the same count; return when the last was."""
    for cycle in range(1, cycles + 1):
        watch.is_lost(from_ns + cycle * 2 * NS_PER_MS, beats)
    return from_ns + cycles * 2 * NS_PER_MS


def test_it_is_lost_once_it_has_been_silent_for_longer_than_it_may() -> None:
    watch = PendantWatch(100.0)
    assert watch.lost is False
    now_ns = silent(watch, 0, 10**12, 1000)
    assert not watch.lost, "one that was never heard is not missed"
    for beats in (1, 2):
        now_ns = silent(watch, beats, now_ns, 1 + 50)
        assert not watch.lost
        now_ns = silent(watch, beats, now_ns, 1)
        assert watch.lost
    assert not watch.is_lost(now_ns + 1, 3), "it is heard again: what was stopped stays so"
    silent(watch, 3, now_ns, 60)
    assert watch.lost
    silent(watch, 0, now_ns, 1000)
    assert not watch.lost, "laid down"


def test_where_the_whole_machine_stood_still_no_process_was_silent() -> None:
    watch = PendantWatch(100.0)
    now_ns = silent(watch, 1, 10**12, 10)
    assert not watch.is_lost(now_ns + 10**10, 1)
    assert not watch.is_lost(now_ns + 10**10 + 2 * NS_PER_MS, 2)
    now_ns = silent(watch, 2, now_ns + 10**10, 10)
    for stall in range(1, 6):
        watch.is_lost(now_ns + stall * 10**9, 2)
    assert watch.lost, "in all it was: 5 times 20 ms"
