"""Rules of the control path: a clamp, and drop-outs that are counted and forgotten."""

from __future__ import annotations

import math
import struct

from hypothesis import assume, example, given
from hypothesis import strategies as st

from shared.clamp import clamp
from shared.robot.hold_rules import Dropouts

COUNT_MAX, FORGET_NS, T0 = 3, 1000, 50_000


def advance(dropouts: Dropouts, now_ns: int, *, engaged: bool = True, dropped: bool = False) -> int:
    dropouts.advance(
        now_ns, engaged=engaged, dropped=dropped, count_max=COUNT_MAX, forget_ns=FORGET_NS
    )
    return dropouts.count


def test_each_steady_time_forgets_one_drop_out() -> None:
    dropouts = Dropouts(count=2, steady_since_ns=T0 - 10**12)
    advance(dropouts, T0, engaged=False)  # only time engaged counts
    for after_ns, left in (
        (FORGET_NS - 1, 2),
        (FORGET_NS, 1),
        (2 * FORGET_NS - 1, 1),
        (2 * FORGET_NS, 0),
        (4 * FORGET_NS, 0),
    ):
        assert advance(dropouts, T0 + after_ns) == left, after_ns


def test_a_drop_out_restarts_the_steady_time_and_counts_only_while_engaged() -> None:
    dropouts = Dropouts(count=1, steady_since_ns=T0)
    assert advance(dropouts, T0 + FORGET_NS - 1, dropped=True) == 2
    assert dropouts.last_ns == T0 + FORGET_NS - 1
    assert advance(dropouts, T0 + 2 * FORGET_NS - 2) == 2
    assert advance(dropouts, T0 + 2 * FORGET_NS - 1) == 1
    dropouts = Dropouts()
    assert advance(dropouts, T0, engaged=False, dropped=True) == 0
    assert dropouts.last_ns == 0


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 3 * FORGET_NS))))
def test_the_count_stays_between_zero_and_its_maximum_and_changes_by_one(
    steps: list[tuple[bool, bool, int]],
) -> None:
    dropouts, now_ns, before = Dropouts(), T0, 0
    for engaged, dropped, pause_ns in steps:
        now_ns += pause_ns
        count = advance(dropouts, now_ns, engaged=engaged, dropped=dropped)
        assert 0 <= count <= COUNT_MAX
        assert abs(count - before) <= 1
        before = count


NUMBERS = st.floats(allow_nan=True, allow_infinity=True)
LIMITS = st.floats(allow_nan=False)


@given(NUMBERS, LIMITS, LIMITS)
@example(-0.0, -1.0, 0.0)
@example(0.0, -0.0, 1.0)
def test_it_is_the_built_ins_to_the_last_bit(value: float, a: float, b: float) -> None:
    low, high = min(a, b), max(a, b)
    assume(low < high)
    expected = min(high, max(low, value))
    assert struct.pack("<d", clamp(value, low, high)) == struct.pack("<d", expected)


def test_a_nan_becomes_the_lower_limit() -> None:
    assert clamp(math.nan, -1.0, 2.0) == -1.0
