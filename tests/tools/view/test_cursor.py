"""Where in a record a page is."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from tools.view.server import RATES, TimelineCursor

NUMBERS = st.none() | st.floats(allow_nan=True, allow_infinity=True)
CONTROLS = st.tuples(st.floats(0.0, 10.0), st.none() | st.booleans(), NUMBERS, NUMBERS)


@given(st.lists(CONTROLS))
def test_whatever_a_page_asks_for_it_stays_within_the_record(
    asked: list[tuple[float, bool | None, float | None, float | None]],
) -> None:
    cursor, now_s = TimelineCursor(-3.0, 20.0), 0.0
    for waits_s, play, seek_s, rate in asked:
        now_s += waits_s
        cursor.control(now_s, play, seek_s, rate)
        place = cursor.at(now_s)
        assert math.isfinite(place)
        assert -3.0 <= place <= 20.0


def test_it_begins_where_the_scenario_does_and_waits() -> None:
    cursor = TimelineCursor(-3.0, 20.0)
    assert (cursor.at(5.0), cursor.playing) == (0.0, False)


def test_it_plays_at_its_rate_stops_at_the_end_and_begins_anew() -> None:
    cursor = TimelineCursor(0.0, 10.0)
    cursor.control(100.0, True, None, 2.0)
    assert cursor.at(101.5) == 3.0
    cursor.control(101.5, None, None, 0.5)
    assert cursor.at(103.5) == 4.0, "a new rate makes no jump"
    assert cursor.at(1000.0) == 10.0
    assert not cursor.playing
    cursor.control(1000.0, True, None, None)
    assert cursor.at(1001.0) == 0.5


def test_rates_have_limits_and_a_record_without_length_never_plays() -> None:
    cursor = TimelineCursor(0.0, 100.0)
    cursor.control(0.0, True, None, 1e9)
    assert cursor.at(1.0) == RATES[1]
    nothing = TimelineCursor(0.0, 0.0)
    nothing.control(0.0, True, None, None)
    assert not nothing.playing
