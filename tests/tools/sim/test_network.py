"""The modelled network."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus.messages import SimControl
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.impairment import Impairment
from shared.config.scenarios import Inject
from shared.links import WRENCHES
from tools.sim.network import BASE, VirtualLink, VirtualNetwork


def message(number: int) -> SimControl:
    return SimControl(t_ns=0, seq=number, start=True)


def link(seed: int = 0, **what: float) -> VirtualLink[SimControl]:
    return VirtualLink(Impairment(**what), "planner->knee_left", seed)  # type: ignore[arg-type]


def arrivals(one: VirtualLink[SimControl], until_ms: int) -> list[tuple[int, int]]:
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


@pytest.mark.parametrize(
    "then", [None, Impairment(delay_ms=1.0), Impairment(delay_ms=9.0, jitter_ms=9.0, duplicate=1.0)]
)
def test_a_stream_stays_in_order_when_its_delay_ends_or_changes(then: Impairment | None) -> None:
    one = link()
    one.direction.begin(1, Impairment(delay_ms=100.0, ordered=True))
    one.put(0, message(1))
    if then is not None:
        one.direction.begin(2, then)
    one.direction.end(1)
    one.release(50 * NS_PER_MS)
    one.put(60 * NS_PER_MS, message(2))
    assert one.take(100 * NS_PER_MS - 1) is None, "not 2 before 1"
    assert one.take(100 * NS_PER_MS) == message(2)
    one.put(101 * NS_PER_MS, message(3))
    assert one.take(120 * NS_PER_MS) == message(3), "the stream has passed"


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["put", "begin", "end"]),
            st.integers(1, 3),
            st.builds(
                Impairment,
                delay_ms=st.floats(0, 50),
                jitter_ms=st.floats(0, 50),
                ordered=st.just(True),
                partition=st.booleans(),
            ),
        ),
        max_size=30,
    )
)
def test_nothing_on_a_stream_is_ever_overtaken_or_lost(
    changes: list[tuple[str, int, Impairment]],
) -> None:
    one, sent, came = link(), 0, 0
    for ms, (change, number, what) in enumerate(changes):
        now_ns = ms * NS_PER_MS
        if change == "put":
            sent += 1
            one.put(now_ns, message(sent))
        elif change == "end":
            one.direction.end(number)
        elif one.direction.requested(number) is None:
            one.direction.begin(number, what)
        one.release(now_ns)
        found = one.take(now_ns)
        came = came if found is None else found.seq
    for number in (1, 2, 3):
        one.direction.end(number)
    one.release(NS_PER_S)
    last = one.take(10 * NS_PER_S)
    assert one.overtaken == 0
    assert (came if last is None else last.seq) == sent


@pytest.mark.parametrize(
    ("ends", "arrive"), [((2,), [(200, 1), (260, 2), (270, 3)]), ((1, 2), [(200, 3)])]
)
def test_what_a_partition_held_is_as_late_as_what_comes_after_and_behind_what_was_late_before(
    ends: tuple[int, ...], arrive: list[tuple[int, int]]
) -> None:
    one = link()
    one.direction.begin(1, Impairment(delay_ms=200.0, ordered=True))
    one.put(0, message(1))
    one.direction.begin(2, Impairment(partition=True, ordered=True))
    one.put(20 * NS_PER_MS, message(2))
    for number in ends:
        one.direction.end(number)
    one.release(60 * NS_PER_MS)
    one.put(70 * NS_PER_MS, message(3))
    assert arrivals(one, 300) == arrive
    assert one.overtaken == 0


def test_what_a_partition_held_comes_before_what_is_sent_after_it() -> None:
    one = link()
    one.direction.begin(1, Impairment(partition=True, ordered=True))
    one.put(0, message(1))
    one.direction.end(1)
    one.direction.begin(2, Impairment(delay_ms=50.0, jitter_ms=50.0))
    one.release(60 * NS_PER_MS)
    for number in range(2, 30):
        one.put(60 * NS_PER_MS, message(number))
    assert one.take(110 * NS_PER_MS - 1) is None


def network(*injects: Inject) -> tuple[VirtualNetwork, list[LinkEvent]]:
    events: list[LinkEvent] = []
    return VirtualNetwork(BASE, injects, 0, events.append), events


def test_an_impairment_that_lasts_to_the_end_of_a_run_reports_its_counts_then() -> None:
    made, told = network(
        Inject(link="harness->planner", at=0.0, loss=1.0), Inject(link="all", at=9.0, loss=1.0)
    )
    made.advance(0.0, 0)
    for number in range(5):
        made.links[WRENCHES].put(number, message(number))
    made.end(7 * NS_PER_MS)
    begun, ended = told
    assert (begun.active, ended.active) == (True, False)
    assert (ended.t_ns, ended.passed, ended.lost) == (7 * NS_PER_MS, 0, 5)
