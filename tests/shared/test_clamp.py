"""The one way to limit a number, against the two built-ins that it stands for."""

from __future__ import annotations

import math
import struct

from hypothesis import assume, example, given
from hypothesis import strategies as st

from shared.clamp import clamp

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
