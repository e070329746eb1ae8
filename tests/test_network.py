"""The modelled network."""

from __future__ import annotations

import pytest

from shared.clock import NS_PER_MS
from shared.impairment import Impairment
from shared.messages import SimControl
from tools.runs.network import Link


def message(number: int) -> SimControl:
    return SimControl(t_ns=0, seq=number, start=True)


def link(seed: int = 0, **what: float) -> Link[SimControl]:
    return Link(Impairment(**what), "planner->knee_left", seed)  # type: ignore[arg-type]


def arrivals(one: Link[SimControl], until_ms: int) -> list[tuple[int, int]]:
    """Return (ms, number) as they are taken, looking once a millisecond."""
    seen = []
    for ms in range(until_ms):
        found = one.take(ms * NS_PER_MS)
        if found is not None:
            seen.append((ms, found.seq))
    return seen


def test_a_message_takes_the_delay() -> None:
    one = link(delay_ms=7.0)
    one.put(0, message(1))
    assert one.take(7 * NS_PER_MS - 1) is None
    assert one.take(7 * NS_PER_MS) == message(1)
    assert one.take(8 * NS_PER_MS) is None, "taken once"


def test_only_the_newest_arrival_is_kept() -> None:
    one = link(delay_ms=1.0)
    for number in range(5):
        one.put(number, message(number))
    assert one.take(10 * NS_PER_MS) == message(4)


def test_what_is_overtaken_is_dropped_as_zenoh_does() -> None:
    one = link(delay_ms=10.0, jitter_ms=10.0)
    for number in range(200):
        one.put(number * NS_PER_MS, message(number))
    seen = arrivals(one, 300)
    assert all(0 <= ms - number <= 21 for ms, number in seen)
    numbers = [number for _, number in seen]
    assert numbers == sorted(numbers)
    assert one.overtaken > 20


def test_what_comes_twice_is_taken_once() -> None:
    one = link(duplicate=1.0, delay_ms=5.0)
    one.put(0, message(1))
    assert [number for _, number in arrivals(one, 20)] == [1]
    assert one.overtaken == 1


@pytest.mark.parametrize("loss", [0.0, 0.3, 1.0])
def test_as_many_are_lost_as_asked(loss: float) -> None:
    one = link(loss=loss)
    came = 0
    for number in range(4000):
        one.put(number, message(number))
        came += one.take(number) is not None
    assert came / 4000 == pytest.approx(1.0 - loss, abs=0.03)


def test_the_same_seed_does_the_same_and_another_does_not() -> None:
    def lost(seed: int) -> list[bool]:
        one = link(seed, loss=0.5)
        outcome = []
        for number in range(100):
            one.put(number, message(number))
            outcome.append(one.take(number) is None)
        return outcome

    assert lost(1) == lost(1)
    assert lost(1) != lost(2)


def test_what_is_injected_comes_on_top_of_what_the_link_does_by_itself() -> None:
    one = link(delay_ms=1.0)
    one.direction.begin(1, Impairment(delay_ms=30.0))
    one.put(0, message(1))
    assert arrivals(one, 100) == [(31, 1)]


def test_a_healed_stream_delivers_what_was_held_and_datagrams_are_gone() -> None:
    for ordered in (True, False):
        one = link(delay_ms=1.0)
        one.direction.begin(1, Impairment(partition=True, ordered=ordered))
        one.put(0, message(1))
        assert arrivals(one, 50) == []
        one.direction.end(1)
        one.release(50 * NS_PER_MS)
        assert (one.take(51 * NS_PER_MS) == message(1)) is ordered


def test_a_slow_line_counts_the_bytes_of_a_message() -> None:
    one = link()
    one.direction.begin(1, Impairment(rate=10_000.0))
    one.put(0, message(1))
    ((ms, _),) = arrivals(one, 100)
    assert 6 <= ms <= 10  # 30 bytes and 40 of overhead, at 10 to the millisecond
