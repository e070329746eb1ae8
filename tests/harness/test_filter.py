from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.harness.filter import (
    TARE_DEVIATION_MAX,
    FilteredWrench,
    FilterState,
    WrenchFilter,
    start_tare,
)
from shared.bus.messages import Tare
from shared.can.loadcell_can import as_sent
from shared.clock import NS_PER_MS, NS_PER_S
from tests.harness.helpers import (
    HARNESS,
    PERIOD_NS,
    T0,
    TARE_CYCLES,
    ZERO,
    G,
    harness_with,
    legs,
    six,
)

Array = npt.NDArray[np.float64]
LAW = WrenchFilter(HARNESS)
STALE_NS = round(HARNESS.stale_ms * NS_PER_MS)
TARE_NS = round(HARNESS.tare_s * NS_PER_S)
LIMIT = HARNESS.leg_force_max

biases = st.tuples(*[st.floats(-200.0, 200.0)] * 6)


def feed(
    law: WrenchFilter, state: FilterState, t_ns: int, forces: tuple[float, ...]
) -> tuple[FilterState, FilteredWrench]:
    return law.step(state, t_ns, six(forces))


def tared(law: WrenchFilter = LAW, bias: tuple[float, ...] = ZERO) -> tuple[FilterState, int]:
    """Return a state after the tare, and the time of its last sample."""
    state, t_ns = FilterState(), T0
    while True:
        state, reading = feed(law, state, t_ns, bias)
        if reading.valid:
            return state, t_ns
        assert t_ns < T0 + 10 * NS_PER_S
        t_ns += PERIOD_NS


def settled(
    law: WrenchFilter, state: FilterState, t_ns: int, forces: tuple[float, ...]
) -> tuple[FilterState, FilteredWrench, int]:
    """Feed constant forces for 0.5 s: 20 time constants of the low-pass and more."""
    reading = law.step(state, t_ns, None)[1]
    for _ in range(125):
        t_ns += PERIOD_NS
        state, reading = feed(law, state, t_ns, forces)
    return state, reading, t_ns


def test_valid_comes_exactly_when_the_tare_time_is_full() -> None:
    state, reading = LAW.step(FilterState(), T0, None)
    assert (reading.valid, reading.age_ns) == (False, -1), "nor before the first sample"
    assert not reading.wrench.any()
    assert state.tare is not Tare.DONE
    for t_ns in range(T0, T0 + TARE_NS, PERIOD_NS):
        state, reading = feed(LAW, state, t_ns, ZERO)
        assert not reading.valid
    before, reading = feed(LAW, state, T0 + TARE_NS - 1, ZERO)
    assert not reading.valid
    _, reading = feed(LAW, before, T0 + TARE_NS, ZERO)
    assert reading.valid


@settings(max_examples=30)
@given(bias=biases, wrench=st.tuples(*[st.floats(-40.0, 40.0)] * 6))
def test_tare_removes_any_constant_bias(
    bias: tuple[float, ...], wrench: tuple[float, ...]
) -> None:  # fmt: skip
    state, t_ns = tared(bias=bias)
    loaded = tuple(np.add(bias, legs(wrench)))
    _, reading, _ = settled(LAW, state, t_ns, loaded)
    assert reading.valid
    np.testing.assert_allclose(reading.wrench, wrench, atol=1e-6)


def test_tare_averages_noise_and_a_gap_of_just_the_stale_time_does_not_disturb_it() -> None:
    noise = np.random.default_rng(1).standard_normal((200, 6))
    for gap_ns in (PERIOD_NS, STALE_NS):
        state, t_ns, used = FilterState(), T0, 0
        while state.tare is not Tare.DONE:
            state, _ = feed(LAW, state, t_ns, tuple(50.0 + noise[used]))
            used, t_ns = used + 1, t_ns + gap_ns
        np.testing.assert_allclose(state.offset, 50.0 + noise[:used].mean(axis=0))
        assert t_ns - gap_ns == T0 + TARE_NS


@pytest.mark.parametrize("disturbance", ["gap", "saturation"])
def test_a_disturbed_tare_starts_over_and_forgets_what_it_had(disturbance: str) -> None:
    state, t_ns = FilterState(), T0
    for _ in range(100):
        state, _ = feed(LAW, state, t_ns, (100.0,) * 6)
        t_ns += PERIOD_NS
    if disturbance == "gap":
        t_ns += STALE_NS
    else:
        state, reading = feed(LAW, state, t_ns, (LIMIT,) * 6)
        assert reading.saturated
        t_ns += PERIOD_NS
    begun_ns = t_ns
    while state.tare is not Tare.DONE:
        state, reading = feed(LAW, state, t_ns, (7.0,) * 6)
        t_ns += PERIOD_NS
    assert t_ns - PERIOD_NS - begun_ns >= TARE_NS
    np.testing.assert_allclose(state.offset, 7.0)
    assert reading.valid


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_tare_is_taken_up_to_the_limit_of_the_forces_deviation(leg: int, share: float) -> None:
    """Alternating between two values, the deviation is half their distance, whatever the bias."""
    state, t_ns = FilterState(), T0
    for n in range(TARE_CYCLES + 1):
        forces = [1000.0] * 6
        forces[leg] += 2.0 * share * TARE_DEVIATION_MAX * (n % 2)
        state, reading = feed(LAW, state, t_ns, tuple(forces))
        t_ns += PERIOD_NS
    assert reading.valid is (share < 1.0)
    assert state.tare is (Tare.DONE if share < 1.0 else Tare.UNSTEADY)


def test_tare_can_be_started_again_and_keeps_the_last_wrench_meanwhile() -> None:
    state, t_ns = tared()
    state, before, t_ns = settled(LAW, state, t_ns, legs((10.0, 0, 0, 0, 0, 0)))
    state = start_tare(state)
    state, reading = LAW.step(state, t_ns, None)
    assert not reading.valid
    seen_invalid = 0
    while state.tare is not Tare.DONE:
        np.testing.assert_array_equal(reading.wrench, before.wrench)
        t_ns += PERIOD_NS
        state, reading = feed(LAW, state, t_ns, legs((30.0, 0, 0, 0, 0, 0)))
        seen_invalid += not reading.valid
    assert seen_invalid >= TARE_NS // PERIOD_NS
    assert reading.valid
    assert not reading.wrench.any(), "what was there during the tare is now zero"
    _, reading, _ = settled(LAW, state, t_ns, legs((31.0, 0, 0, 0, 0, 0)))
    assert reading.wrench[0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("low_pass_hz", [1.0, 10.0, 40.0, 100.0])
@pytest.mark.parametrize("period_ns", [NS_PER_MS, 4 * NS_PER_MS, 7_123_457])
def test_step_response_is_the_analytic_one(low_pass_hz: float, period_ns: int) -> None:
    law = WrenchFilter(harness_with(low_pass_hz=low_pass_hz))
    state, begun_ns = tared(law)
    wrench = np.array([20.0, -10.0, 30.0, 1.0, -2.0, 3.0])
    forces = legs(wrench)
    for n in range(1, 60):
        t_ns = begun_ns + n * period_ns
        state, reading = feed(law, state, t_ns, forces)
        share = 1.0 - math.exp(-2.0 * math.pi * low_pass_hz * n * period_ns / NS_PER_S)
        np.testing.assert_allclose(reading.wrench, share * wrench, atol=1e-9)


@given(cuts=st.lists(st.integers(1, 19 * NS_PER_MS), min_size=1, max_size=8))
def test_step_response_does_not_depend_on_when_samples_come(cuts: list[int]) -> None:
    state, t_ns = tared()
    begun_ns = t_ns
    forces = legs((20.0, 0, 0, 0, 0, 0))
    for cut in cuts:
        t_ns += cut
        state, reading = feed(LAW, state, t_ns, forces)
    elapsed = (t_ns - begun_ns) / NS_PER_S
    expected = 20.0 * (1.0 - math.exp(-2.0 * math.pi * HARNESS.low_pass_hz * elapsed))
    assert reading.wrench[0] == pytest.approx(expected, abs=1e-9)


LAST_BELOW = float(np.nextafter(np.float32(LIMIT), np.float32(0)))
LEVELS = (
    *((level, False) for level in (0.0, 0.5 * LIMIT, LIMIT - 1.0, LAST_BELOW)),
    *((level, True) for level in (LIMIT, math.nextafter(LIMIT, math.inf), LIMIT + 1.0, 3e38)),
)


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("level", "saturated"), LEVELS)
def test_saturation_is_reported_of_any_leg_at_the_limit_and_not_below(
    leg: int, sign: float, level: float, saturated: bool
) -> None:
    state, t_ns = tared()
    state, before, t_ns = settled(LAW, state, t_ns, legs((20.0, 0, 5.0, 0, 1.0, 0)))
    forces = [0.0] * 6
    forces[leg] = sign * level
    _, reading = feed(LAW, state, t_ns + PERIOD_NS, tuple(forces))
    assert reading.saturated is saturated
    assert reading.valid is not saturated
    if saturated:
        np.testing.assert_array_equal(reading.wrench, before.wrench)
    else:
        assert (reading.wrench != before.wrench).any()


@given(limit=st.floats(1.0, 1e5))
def test_a_cell_at_the_end_of_its_range_is_saturated_whatever_float32_makes_of_it(
    limit: float,
) -> None:
    law = WrenchFilter(harness_with(leg_force_max=limit))
    _, reading = feed(law, FilterState(), T0, (as_sent(limit), *ZERO[1:]))
    assert reading.saturated


def test_saturation_is_judged_before_the_tare_and_ends_with_the_first_sample_below_it() -> None:
    for level in (0.0, LIMIT - 10.0):
        state, t_ns = tared(bias=(level,) * 6)
        state, reading = feed(LAW, state, t_ns + PERIOD_NS, (LIMIT, *[level] * 5))
        assert reading.saturated
        state, reading = LAW.step(state, t_ns + PERIOD_NS + 1, None)
        assert (reading.saturated, reading.valid) == (True, False)
        _, reading = feed(LAW, state, t_ns + 2 * PERIOD_NS, (level,) * 6)
        assert (reading.saturated, reading.valid) == (False, True)


def test_a_sample_is_usable_up_to_the_stale_age_and_not_beyond() -> None:
    state, t_ns = tared()
    for age_ns in (-1, 0, 1, STALE_NS // 2, STALE_NS - 1, STALE_NS, STALE_NS + 1, 100 * STALE_NS):
        _, reading = LAW.step(state, t_ns + age_ns, None)
        assert (reading.valid, reading.age_ns) == (0 <= age_ns <= STALE_NS, age_ns)


def test_the_last_good_wrench_is_kept_while_stale_and_replaced_by_the_next_sample() -> None:
    """A sample seen twice or out of order does not move it."""
    state, t_ns = tared()
    state, before, t_ns = settled(LAW, state, t_ns, legs((20.0, 0, 0, 0, 0, 0)))
    for again_ns in (t_ns, t_ns - PERIOD_NS):
        _, reading = feed(LAW, state, again_ns, legs((999.0, 0, 0, 0, 0, 0)))
        np.testing.assert_array_equal(reading.wrench, before.wrench)
    state, reading = LAW.step(state, t_ns + NS_PER_S, None)
    assert not reading.valid
    np.testing.assert_array_equal(reading.wrench, before.wrench)
    _, reading = feed(LAW, state, t_ns + NS_PER_S, legs((0, 9.0, 0, 0, 0, 0)))
    assert reading.valid
    np.testing.assert_allclose(reading.wrench, [0, 9.0, 0, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("taring", [True, False])
def test_a_force_that_is_not_finite_is_refused_and_counted(
    leg: int, number: float, taring: bool
) -> None:
    state, t_ns = tared()
    if taring:
        state, _ = feed(LAW, start_tare(state), t_ns, ZERO)
    forces = [0.0] * 6
    forces[leg] = number
    after, reading = feed(LAW, state, t_ns + PERIOD_NS, tuple(forces))
    assert after.refused == state.refused + 1
    assert reading.age_ns == PERIOD_NS, "it counts as no sample"
    assert np.isfinite(after.wrench).all()
    assert np.isfinite(after.tare_sum).all()


@given(
    stream=st.lists(
        st.tuples(
            st.integers(0, 40 * NS_PER_MS),
            st.one_of(st.none(), st.tuples(*[st.floats(width=32)] * 6)),
        ),
        max_size=40,
    ),
    tare_ms=st.sampled_from([1.0, 20.0]),
)
def test_whatever_the_sensor_sends_the_reading_is_finite(
    stream: list[tuple[int, tuple[float, ...] | None]], tare_ms: float
) -> None:
    law = WrenchFilter(harness_with(tare_s=tare_ms / 1e3))
    state, now_ns = FilterState(), T0
    for dt_ns, forces in stream:
        now_ns += dt_ns
        state, reading = law.step(state, now_ns, None if forces is None else six(forces))
        assert np.isfinite(reading.wrench).all()
        if reading.valid:
            assert not reading.saturated
            assert state.tare is Tare.DONE
            assert 0 <= reading.age_ns <= STALE_NS


def test_a_step_changes_neither_the_state_nor_the_reading_before_it() -> None:
    state, t_ns = tared()
    later, first = feed(LAW, state, t_ns + PERIOD_NS, (10.0,) * 6)
    kept = first.wrench.copy()
    feed(LAW, later, t_ns + 2 * PERIOD_NS, (500.0,) * 6)
    np.testing.assert_array_equal(first.wrench, kept)
    again, repeated = feed(LAW, state, t_ns + PERIOD_NS, (10.0,) * 6)
    np.testing.assert_array_equal(repeated.wrench, kept)
    assert again.wrench_t_ns == later.wrench_t_ns


def test_the_wrench_is_the_geometry_matrix_times_the_leg_forces() -> None:
    state, t_ns = tared()
    forces = (10.0, -20.0, 30.0, -40.0, 50.0, -60.0)
    _, reading, _ = settled(LAW, state, t_ns, forces)
    np.testing.assert_allclose(reading.wrench, G @ forces, atol=1e-9)
