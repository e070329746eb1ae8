"""The modelled network."""

from __future__ import annotations

from itertools import pairwise

import pytest

from shared.clock import NS_PER_MS
from tools.runs.network import Impairment, Link


def arrivals(link: Link[int], until_ms: int) -> list[tuple[int, int]]:
    """Return (ms, message) as they are taken, looking once a millisecond."""
    seen = []
    for ms in range(until_ms):
        message = link.take(ms * NS_PER_MS)
        if message is not None:
            seen.append((ms, message))
    return seen


def test_a_message_takes_the_delay() -> None:
    link = Link[int](Impairment(delay_ms=7.0), "a")
    link.put(0, 1)
    assert link.take(7 * NS_PER_MS - 1) is None
    assert link.take(7 * NS_PER_MS) == 1
    assert link.take(8 * NS_PER_MS) is None, "taken once"


def test_only_the_newest_arrival_is_kept() -> None:
    link = Link[int](Impairment(delay_ms=1.0), "a")
    for number in range(5):
        link.put(number, number)
    assert link.take(10 * NS_PER_MS) == 4


def test_jitter_stays_in_its_bounds_and_reorders() -> None:
    link = Link[int](Impairment(delay_ms=10.0, jitter_ms=10.0), "a")
    for number in range(200):
        link.put(number * NS_PER_MS, number)
    seen = arrivals(link, 300)
    assert all(0 <= ms - number <= 21 for ms, number in seen)
    assert any(b < a for (_, a), (_, b) in pairwise(seen))


@pytest.mark.parametrize("loss", [0.0, 0.3, 1.0])
def test_as_many_are_lost_as_asked(loss: float) -> None:
    link = Link[int](Impairment(delay_ms=0.0, loss=loss), "a")
    came = 0
    for number in range(4000):
        link.put(number, number)
        came += link.take(number) is not None
    assert came / 4000 == pytest.approx(1.0 - loss, abs=0.03)


def test_the_same_seed_does_the_same_and_another_does_not() -> None:
    def lost(seed: str) -> list[bool]:
        link = Link[int](Impairment(delay_ms=0.0, loss=0.5), seed)
        outcome = []
        for number in range(100):
            link.put(number, number)
            outcome.append(link.take(number) is None)
        return outcome

    assert lost("a") == lost("a")
    assert lost("a") != lost("b")
