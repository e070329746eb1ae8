"""The table of `xrl bench`: medians, ratios and targets from turns."""

from __future__ import annotations

import pytest

from tools.lab.bench.table import row_of
from tools.lab.bench.timing import Cost, Spread
from tools.lab.bench.worker import Answer, Request

TICK = Request("tick", calls=9)


def timed(us: float, yard: float = 100.0) -> Answer:
    spread = Spread(0.9 * us, us, 1.1 * us)
    return Answer(yard, cost=Cost(spread, Spread(us, us + 5.0, us)))


def test_a_time_is_the_median_of_the_turns_with_its_ratio_to_the_yardstick() -> None:
    row = row_of(TICK, [timed(300.0, 150.0), timed(200.0), timed(900.0, 450.0)], [], 250.0)
    assert row is not None
    assert (row.what, row.value, row.wall) == ("tick, warm", 300.0, 305.0)
    assert row.spread == (200.0, 900.0)
    assert row.to_yardstick == 2.0
    assert row.ratio is None
    assert not row.ok


def test_cold_calls_are_named_so() -> None:
    row = row_of(Request("tick", cold=True, calls=9), [timed(100.0)], [], None)
    assert row is not None
    assert row.what == "tick, cold"
    assert row.ok


def test_two_revisions_are_compared_turn_by_turn() -> None:
    """The machine was half as fast in the second turn: the ratio does not see it."""
    row = row_of(TICK, [timed(100.0), timed(200.0)], [timed(125.0), timed(250.0)], None)
    assert row is not None
    assert row.other == 187.5
    assert row.ratio == pytest.approx(0.8)


def test_a_part_that_a_tree_does_not_have_has_no_row_and_no_ratio() -> None:
    lacking = Answer(100.0, missing="ImportError")
    assert row_of(TICK, [lacking], [timed(1.0)], None) is None
    row = row_of(TICK, [timed(1.0)], [lacking], None)
    assert row is not None
    assert (row.other, row.ratio) == (None, None)


def test_a_faster_lockstep_has_a_ratio_below_one_and_meets_a_target_from_above() -> None:
    request, here, there = Request("lockstep"), Answer(100.0, speed=4.0), Answer(100.0, speed=2.0)
    row = row_of(request, [here], [there], 4.0)
    assert row is not None
    assert (row.what, row.unit, row.value) == ("lockstep", "x", 4.0)
    assert (row.other, row.ratio, row.ok) == (2.0, 0.5, True)
    missed = row_of(request, [here], [], 4.1)
    assert missed is not None
    assert not missed.ok
