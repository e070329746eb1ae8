"""A sensor that repeats itself is dead: the whole of it, or one of its six cells."""

from __future__ import annotations

import numpy as np
import pytest

from services.harness.filter import FROZEN_NS, FilteredWrench, FilterState, WrenchFilter
from shared.bus.messages import Tare
from tests.harness.helpers import HARNESS, PERIOD_NS, T0, TARE_CYCLES, six

LAW = WrenchFilter(HARNESS)
CYCLES = FROZEN_NS // PERIOD_NS
ALL = list(range(6))


def run(
    state: FilterState, t_ns: int, cycles: int, frozen: list[int]
) -> tuple[FilterState, FilteredWrench, int]:
    """Feed cells with noise, but for frozen ones, which stay at 0."""
    noise = np.random.default_rng(t_ns).standard_normal((cycles, 6))
    noise[:, frozen] = 0.0
    for forces in noise:
        t_ns += PERIOD_NS
        state, reading = LAW.step(state, t_ns, six(forces))
    return state, reading, t_ns


def live() -> tuple[FilterState, int]:
    state, reading, t_ns = run(FilterState(), T0, TARE_CYCLES + 2, [])
    assert reading.valid
    return state, t_ns


@pytest.mark.parametrize("cells", [ALL, [0], [3], [1, 5]])
def test_cells_that_repeat_their_reading_make_the_wrench_invalid_in_time(cells: list[int]) -> None:
    state, t_ns = live()
    state, reading, t_ns = run(state, t_ns, CYCLES, cells)
    assert reading.valid
    before = reading.wrench
    state, reading, t_ns = run(state, t_ns, 1, cells)
    assert not reading.valid
    state, reading, t_ns = run(state, t_ns, 500, cells)
    assert not reading.valid
    np.testing.assert_array_equal(reading.wrench, before)
    _, reading, _ = run(state, t_ns, 1, [])
    assert reading.valid, "it has come back"


def test_a_frozen_sensor_never_counts_as_tared() -> None:
    state, reading, t_ns = run(FilterState(), T0, 10 * TARE_CYCLES, [2])
    assert not reading.valid
    assert state.tare is not Tare.DONE
    state, reading, _ = run(state, t_ns, TARE_CYCLES + 2, [])
    assert state.tare is Tare.DONE
    assert reading.valid
