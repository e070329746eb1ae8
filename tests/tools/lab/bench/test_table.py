"""The tables of `xrl bench`: medians, ratios and targets from turns."""

from __future__ import annotations

import pytest

from tools.lab.bench.table import PartRow, Row, row_of
from tools.lab.bench.timing import Cost, Spread
from tools.lab.bench.worker import Answer, Request

TICK = Request("tick", calls=9)


def timed(us: float, yard: float = 100.0) -> Answer:
    spread = Spread(0.9 * us, us, 1.1 * us)
    return Answer(yard, cost=Cost(spread, Spread(us, us + 5.0, us)))


def rows(
    here: list[Answer], there: list[Answer], target: float | None = None, request: Request = TICK
) -> Row:
    part = row_of(request, here, there, target)
    assert part is not None
    return part.row


def test_a_time_is_the_median_of_the_turns_with_its_ratio_to_the_yardstick() -> None:
    turns = [timed(300.0, 150.0), timed(200.0), timed(900.0, 450.0)]
    assert row_of(TICK, turns, [], 250.0) == PartRow(
        Row("tick, warm", "us", 300.0, (200.0, 900.0), target=250.0), wall=305.0, to_yardstick=2.0
    )
    assert not rows(turns, [], 250.0).ok
    assert rows(turns, [], 300.0).ok


def test_cold_calls_are_named_so() -> None:
    assert rows([timed(1.0)], [], request=Request("tick", cold=True, calls=9)).what == "tick, cold"


def test_a_part_that_a_tree_does_not_have_has_no_row_and_no_ratio() -> None:
    lacking = Answer(100.0, missing="ImportError")
    assert row_of(TICK, [lacking], [timed(1.0)], None) is None
    assert rows([timed(1.0)], [lacking])[4:6] == (None, None)


def test_turns_are_compared_one_by_one() -> None:
    """The machine was half as fast in the second turn: the ratio does not see it."""
    here = [timed(us) for us in (200.0, 400.0, 210.0)]
    there = [timed(us) for us in (250.0, 500.0, 300.0)]
    row = rows(here, there)
    assert (row.value, row.spread, row.other) == (210.0, (200.0, 400.0), 300.0)
    assert row.ratio == pytest.approx(0.8)


def test_a_faster_lockstep_has_a_ratio_below_one_and_meets_a_target_from_above() -> None:
    request, here, there = Request("lockstep"), Answer(100.0, speed=4.0), Answer(100.0, speed=2.0)
    row = rows([here], [there], 4.0, request)
    assert row == Row("lockstep", "x", 4.0, (4.0, 4.0), other=2.0, ratio=0.5, target=4.0)
    assert row.ok
    assert not rows([here], [], 4.1, request).ok
