"""The table of `xrl bench`: medians, ratios and targets from rounds."""

from __future__ import annotations

import pytest

from tools.bench import table
from tools.bench.timing import Cost, Spread
from tools.bench.worker import Round


def done(us: float, speed: float = 2.0, yard: float = 100.0) -> Round:
    spread = Spread(0.9 * us, us, 1.1 * us)
    cost, cold = Cost(spread, Spread(us, us + 5.0, us)), Cost(Spread(us, 3.0 * us, us), spread)
    return Round(yard, {"tick": cost}, {"tick": cold}, {"lockstep": speed})


def test_a_time_is_the_median_of_the_rounds_with_its_ratio_to_the_yardstick() -> None:
    rounds = [done(300.0, yard=150.0), done(200.0), done(900.0, yard=450.0)]
    row = table.timing("tick", cold=False, rounds=rounds, others=[], target=250.0)
    assert row is not None
    assert (row.value, row.wall, row.spread) == (300.0, 305.0, (200.0, 900.0))
    assert row.to_yardstick == 2.0
    assert row.ratio is None
    assert not row.ok


def test_cold_calls_have_a_row_of_their_own() -> None:
    row = table.timing("tick", cold=True, rounds=[done(100.0)], others=[], target=None)
    assert row is not None
    assert row.what == "tick, cold"
    assert row.value == 300.0


def test_two_revisions_are_compared_round_by_round() -> None:
    """The machine was half as fast in the second round: the ratio does not see it."""
    here, there = [done(100.0), done(200.0)], [done(125.0), done(250.0)]
    row = table.timing("tick", cold=False, rounds=here, others=there, target=None)
    assert row is not None
    assert row.other == 187.5
    assert row.ratio == pytest.approx(0.8)


def test_a_part_that_a_tree_does_not_have_has_no_row_and_no_ratio() -> None:
    assert table.timing("other", cold=False, rounds=[done(1.0)], others=[], target=1.0) is None
    row = table.timing("tick", cold=False, rounds=[done(1.0)], others=[Round()], target=1.0)
    assert row is not None
    assert row.ratio is None


def test_a_faster_lockstep_has_a_ratio_below_one_and_meets_a_target_from_above() -> None:
    here, there = [done(1.0, speed=4.0)], [done(1.0, speed=2.0)]
    row = table.speed("lockstep", rounds=here, others=there, target=4.0)
    assert (row.value, row.other, row.ratio, row.ok) == (4.0, 2.0, 0.5, True)
    assert not table.speed("lockstep", rounds=here, others=[], target=4.1).ok
