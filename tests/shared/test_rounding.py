"""Rounded numbers are near, short, and stay what they are."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.rounding import FORCE, POSITION, RATE, TURNS, rounded

NUMBERS = st.floats(-1e6, 1e6)


@given(x=NUMBERS, y=NUMBERS, decimals=st.sampled_from([FORCE, RATE, POSITION, TURNS]))
def test_a_rounded_pair_is_the_nearest_with_its_decimals_and_is_not_changed_again(
    x: float, y: float, decimals: int
) -> None:
    pair = rounded((x, y), decimals)
    assert pair == pytest.approx((x, y), rel=1e-15, abs=0.5001 * 10**-decimals)
    assert pair == tuple(float(f"{number:.{decimals}f}") for number in pair)
    assert rounded(pair, decimals) == pair


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_becomes_nan_without_an_exception(number: float) -> None:
    assert math.isnan(rounded((number, 0.0), FORCE)[0])
