from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.tools.judge.reports.runs import decode_signal
from tools.judge.reports.signals import BINS, Span, encode_signal, message_times, segments

VALUES = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=300)


@given(VALUES, st.floats(0.001, 0.09))
def test_every_signal_keeps_its_extremes_and_its_order(values: list[float], step: float) -> None:
    t = np.arange(len(values)) * step
    span = Span(0.0, max(float(t[-1]), 1.0))
    found = encode_signal(t, np.array(values), span)
    assert found is not None
    assert (found["lo"], found["hi"]) == (min(values), max(values))
    seen_t, seen = decode_signal(found, span.grid)
    resolution = found["step"] + 1e-9
    assert abs(seen.min() - min(values)) <= resolution
    assert abs(seen.max() - max(values)) <= resolution
    assert (np.diff(seen_t) > 0.0).all()
    for where, value in zip(seen_t, seen, strict=True):  # each is a sample of its own bin
        close = np.abs(t - where) <= span.bin_s
        assert np.abs(np.array(values)[close] - value).min() <= resolution


def test_a_peak_of_one_sample_in_a_long_run_is_kept() -> None:
    t = np.arange(0.0, 600.0, 0.004)
    values = np.sin(t)
    values[77_777] = 40.0
    span = Span(0.0, 600.0)
    found = encode_signal(t, values, span)
    assert found is not None
    where, seen = decode_signal(found, span.grid)
    assert len(seen) <= 2 * BINS
    assert abs(seen.max() - 40.0) < 1e-3
    assert abs(where[seen.argmax()] - t[77_777]) <= 600.0 / BINS


def test_silence_breaks_a_line_and_a_missing_sample_does_not() -> None:
    t = np.concatenate((np.arange(0.0, 1.0, 0.004), np.arange(1.5, 2.0, 0.004)))
    t = np.delete(t, [50, 51])
    span = Span(0.0, 2.0)
    found = encode_signal(t, np.ones(len(t)), span)
    assert found is not None
    where, seen = decode_signal(found, span.grid)
    gap = where[np.isnan(seen)]
    assert gap[0] == pytest.approx(1.0, abs=0.005)
    assert gap[-1] == pytest.approx(1.5, abs=0.005)
    assert np.diff(gap).max() < 0.0011, "the cursor finds no value anywhere in the gap"


def test_values_that_are_not_finite_are_left_out() -> None:
    assert encode_signal(np.array([0.0, 1.0]), np.array([np.nan, np.inf]), Span(0.0, 1.0)) is None
    assert encode_signal(np.zeros(0), np.zeros(0), Span(0.0, 1.0)) is None
    found = encode_signal(np.array([0.0, 1.0]), np.array([np.nan, 3.0]), Span(0.0, 1.0))
    assert found is not None
    assert (found["lo"], found["hi"], found["step"]) == (3.0, 3.0, 0.0)


def test_messages_with_a_repeated_stamp_are_spread_until_the_next_stamp() -> None:
    stamps = [*range(0, 100, 4), *[100] * 50, 300, 304]
    t = message_times([stamp * 1_000_000 for stamp in stamps], 0)
    assert (np.diff(t) > 0.0).all()
    assert t[-2:].tolist() == [0.3, 0.304]
    assert np.diff(t).max() <= 0.008 + 1e-9


def test_a_gap_ends_an_interval() -> None:
    t = np.array([0.0, 0.01, 0.02, 0.03, 1.0, 1.01])
    found = segments(t, np.array([1, 1, 2, 2, 2, 2]))
    assert found == [[0.0, 0.02, 1], [0.02, 0.03, 2], [1.0, 1.01, 2]]


def test_a_single_sample_in_a_bin_is_one_point_in_its_own_half() -> None:
    """Two points for one sample would draw every slow signal as steps."""
    t = np.array([0.0, 0.101, 0.305, 0.507, 0.999])
    span = Span(0.0, 1.0)
    found = encode_signal(t, np.arange(5.0), span)
    assert found is not None
    where, seen = decode_signal(found, span.grid)
    assert len(seen) == len(t)
    assert np.abs(where - t).max() <= span.bin_s / 2


def test_a_message_with_a_repeated_stamp_is_placed_by_its_reception() -> None:
    """The recorder's clock is 1 s ahead. No message is placed after the next stamp."""
    stamps = np.array([0, 4, 8, 8, 8, 8, 48, 52]) * 1_000_000
    received = np.array([0, 4, 8, 18, 28, 60, 61, 62]) * 1_000_000 + 1_000_000_000
    t = message_times(stamps.tolist(), 0, received.tolist())
    assert t[:5].tolist() == pytest.approx([0.0, 0.004, 0.008, 0.018, 0.028])
    assert 0.028 < t[5] < 0.048
    assert t[6:].tolist() == pytest.approx([0.048, 0.052])


@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.integers(0, 60)).map(
            lambda pair: (pair[0] * 4_000_000, pair[1] * 1_000_000)
        ),
        min_size=1,
        max_size=60,
    )
)
def test_times_never_fall_and_a_new_stamp_is_its_own_time(steps: list[tuple[int, int]]) -> None:
    stamps = np.cumsum([step for step, _ in steps])
    received = np.cumsum([step for _, step in steps])
    for reception in (None, received.tolist()):
        t = message_times(stamps.tolist(), 0, reception)
        assert (np.diff(t) >= 0.0).all()
        first = np.concatenate(([True], np.diff(stamps) > 0))
        assert t[first] == pytest.approx(stamps[first] / 1e9)
