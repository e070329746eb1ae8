"""Modules that act far apart in time get no tau_coupled; all late alike keep it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.planner.coherence import MOST_NS, NONE_NS, TICKS, WHOLE_NS, Coherence
from shared.clock import NS_PER_MS

WHOLE = (1.0,) * 6
"""Every module would use all of it."""
AGES = st.lists(st.integers(0, 60 * NS_PER_MS), min_size=6, max_size=6)


def after(ages_ms: list[float], ticks: int = 20 * TICKS) -> Coherence:
    coherence = Coherence()
    for _ in range(ticks):
        coherence.take([round(age * NS_PER_MS) for age in ages_ms])
    return coherence


@pytest.mark.parametrize("age_ms", [0.0, 8.0, 49.0])
def test_all_late_alike_keep_all_of_it(age_ms: float) -> None:
    assert after([age_ms] * 6).share(WHOLE) == 1.0


@pytest.mark.parametrize(
    ("spread_ms", "share"), [(0.0, 1.0), (3.9, 1.0), (7.0, 0.5), (10.0, 0.0), (44.0, 0.0)]
)
def test_the_share_falls_between_its_bounds(spread_ms: float, share: float) -> None:
    assert after([4.0, 4.0, 4.0, 4.0, 4.0, 4.0 + spread_ms]).share(WHOLE) == pytest.approx(
        share, abs=0.01
    )


def test_one_late_moment_takes_nothing() -> None:
    coherence = after([4.0] * 6)
    coherence.take([4 * NS_PER_MS] * 5 + [2000 * NS_PER_MS])
    assert coherence.share(WHOLE) == 1.0


def test_it_comes_back_within_half_a_second_of_ticks() -> None:
    coherence = after([4.0] * 5 + [2000.0])
    assert coherence.spread_ns == pytest.approx(MOST_NS, rel=0.01)
    for _ in range(125):
        coherence.take([4 * NS_PER_MS] * 6)
    assert coherence.share(WHOLE) == 1.0


def test_a_module_without_a_command_says_nothing_about_ages() -> None:
    coherence = Coherence()
    coherence.take([-1, 50 * NS_PER_MS, 0, 0, 0, 0])
    assert coherence.spread_ns == 0.0


def test_none_gets_more_than_the_module_whose_commands_are_the_least_steady() -> None:
    coherence = after([4.0] * 6)
    assert coherence.share((1.0, 1.0, 0.3, 1.0, 0.8, 1.0)) == 0.3
    assert after([4.0] * 5 + [30.0]).share((1.0, 1.0, 0.3, 1.0, 0.8, 1.0)) == 0.0


@given(st.lists(AGES, max_size=100))
def test_the_share_is_always_one(rows: list[list[int]]) -> None:
    coherence = Coherence()
    for ages in rows:
        coherence.take(ages)
    assert 0.0 <= coherence.share(WHOLE) <= 1.0
    assert 0.0 <= coherence.spread_ns <= MOST_NS
    assert WHOLE_NS < NONE_NS < MOST_NS
