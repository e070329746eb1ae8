from __future__ import annotations

import math
from collections.abc import Sequence

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
from shared.clock import NS_PER_MS, NS_PER_S
from tests.harness.helpers import (
    HARNESS,
    PERIOD_NS,
    T0,
    TARE_CYCLES,
    ZERO,
    harness_with,
    legs,
    six,
)

LAW = WrenchFilter(HARNESS)
STALE_NS = round(HARNESS.stale_ms * NS_PER_MS)
TARE_NS = round(HARNESS.tare_s * NS_PER_S)
LIMIT = HARNESS.leg_force_max
Forces = Sequence[float] | npt.NDArray[np.float64]


class Fed:
    """A filter that is fed with forces; the first come at T0."""

    def __init__(self, law: WrenchFilter = LAW, bias: Forces | None = ZERO) -> None:
        """Feed a bias until the tare is done, or nothing."""
        self.law, self.state, self.t_ns = law, FilterState(), T0 - PERIOD_NS
        while bias is not None and not self.feed(bias).valid:
            assert self.t_ns < T0 + 10 * NS_PER_S

    def feed(self, forces: Forces, after_ns: int = PERIOD_NS) -> FilteredWrench:
        self.t_ns += after_ns
        self.state, reading = self.law.step(self.state, self.t_ns, six(forces))
        return reading

    def settle(self, forces: Forces) -> FilteredWrench:
        """Feed constant forces for 0.5 s: 20 time constants of the low-pass and more."""
        return [self.feed(forces) for _ in range(125)][-1]

    def look(self, after_ns: int = 0) -> FilteredWrench:
        """Read without a sample, some time after the last."""
        self.state, reading = self.law.step(self.state, self.t_ns + after_ns, None)
        return reading


def only(leg: int, force: float) -> list[float]:
    return [force if each == leg else 0.0 for each in range(6)]


def x(newtons: float) -> Forces:
    return legs((newtons, 0, 0, 0, 0, 0))


def test_valid_comes_exactly_when_the_tare_time_is_full() -> None:
    fed = Fed(bias=None)
    nothing = fed.look()
    assert (nothing.valid, nothing.age_ns, nothing.wrench.any()) == (False, -1, False)
    assert not any(fed.feed(ZERO).valid for _ in range(0, TARE_NS, PERIOD_NS))
    left_ns = T0 + TARE_NS - fed.t_ns
    assert not fed.feed(ZERO, left_ns - 1).valid
    assert fed.feed(ZERO, 1).valid


@settings(max_examples=30)
@given(
    bias=st.tuples(*[st.floats(-200.0, 200.0)] * 6), wrench=st.tuples(*[st.floats(-40.0, 40.0)] * 6)
)
def test_tare_removes_any_constant_bias(
    bias: tuple[float, ...], wrench: tuple[float, ...]
) -> None:  # fmt: skip
    reading = Fed(bias=bias).settle(np.add(bias, legs(wrench)))
    assert reading.valid
    np.testing.assert_allclose(reading.wrench, wrench, atol=1e-6)


def test_tare_averages_noise_and_a_gap_of_just_the_stale_time_does_not_disturb_it() -> None:
    noise = 50.0 + np.random.default_rng(1).standard_normal((200, 6))
    for gap_ns in (PERIOD_NS, STALE_NS):
        fed, used = Fed(bias=None), 0
        while fed.state.tare is not Tare.DONE:
            fed.feed(noise[used], gap_ns if used else PERIOD_NS)
            used += 1
        np.testing.assert_allclose(fed.state.offset, noise[:used].mean(axis=0))
        assert fed.t_ns == T0 + TARE_NS


@pytest.mark.parametrize("disturbance", ["gap", "saturation"])
def test_a_disturbed_tare_starts_over_and_forgets_what_it_had(disturbance: str) -> None:
    fed = Fed(bias=None)
    for _ in range(100):
        fed.feed((100.0,) * 6)
    if disturbance == "saturation":
        assert fed.feed((LIMIT,) * 6).saturated
    fed.feed((7.0,) * 6, PERIOD_NS + STALE_NS if disturbance == "gap" else PERIOD_NS)
    begun_ns = fed.t_ns
    while fed.state.tare is not Tare.DONE:
        reading = fed.feed((7.0,) * 6)
    assert fed.t_ns - begun_ns >= TARE_NS
    np.testing.assert_allclose(fed.state.offset, 7.0)
    assert reading.valid


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_tare_is_taken_up_to_the_limit_of_the_forces_deviation(leg: int, share: float) -> None:
    """Alternating between two values, the deviation is half their distance, whatever the bias."""
    fed, jump = Fed(bias=None), 2.0 * share * TARE_DEVIATION_MAX
    for n in range(TARE_CYCLES + 1):
        reading = fed.feed(np.add(1000.0, only(leg, jump * (n % 2))))
    assert reading.valid is (share < 1.0)
    assert fed.state.tare is (Tare.DONE if share < 1.0 else Tare.UNSTEADY)


def test_tare_can_be_started_again_and_keeps_the_last_wrench_meanwhile() -> None:
    fed = Fed()
    before = fed.settle(x(10.0))
    fed.state = start_tare(fed.state)
    reading, seen_invalid = fed.look(), 0
    assert not reading.valid
    while fed.state.tare is not Tare.DONE:
        np.testing.assert_array_equal(reading.wrench, before.wrench)
        reading = fed.feed(x(30.0))
        seen_invalid += not reading.valid
    assert seen_invalid >= TARE_NS // PERIOD_NS
    assert reading.valid
    assert not reading.wrench.any(), "what was there during the tare is now zero"
    assert fed.settle(x(31.0)).wrench[0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("low_pass_hz", [1.0, 10.0, 40.0, 100.0])
@pytest.mark.parametrize("period_ns", [NS_PER_MS, 4 * NS_PER_MS, 7_123_457])
def test_step_response_is_the_analytic_one(low_pass_hz: float, period_ns: int) -> None:
    fed = Fed(WrenchFilter(harness_with(low_pass_hz=low_pass_hz)))
    wrench = np.array([20.0, -10.0, 30.0, 1.0, -2.0, 3.0])
    for n in range(1, 60):
        reading = fed.feed(legs(wrench), period_ns)
        share = 1.0 - math.exp(-2.0 * math.pi * low_pass_hz * n * period_ns / NS_PER_S)
        np.testing.assert_allclose(reading.wrench, share * wrench, atol=1e-9)


LAST_BELOW = float(np.nextafter(np.float32(LIMIT), np.float32(0)))
BELOW = (0.0, 0.5 * LIMIT, LIMIT - 1.0, LAST_BELOW)
BEYOND = (LIMIT, math.nextafter(LIMIT, math.inf), LIMIT + 1.0, 3e38)


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("level", BELOW + BEYOND)
def test_saturation_is_reported_of_any_leg_at_the_limit_and_not_below(
    leg: int, sign: float, level: float
) -> None:
    fed = Fed()
    before = fed.settle(legs((20.0, 0, 5.0, 0, 1.0, 0)))
    reading = fed.feed(only(leg, sign * level))
    assert (reading.saturated, reading.valid) == (level in BEYOND, level not in BEYOND)
    assert np.array_equal(reading.wrench, before.wrench) is reading.saturated


def test_saturation_is_judged_before_the_tare_and_ends_with_the_first_sample_below_it() -> None:
    for level in (0.0, LIMIT - 10.0):
        fed = Fed(bias=(level,) * 6)
        assert fed.feed((LIMIT, *[level] * 5)).saturated
        reading = fed.look(1)
        assert (reading.saturated, reading.valid) == (True, False)
        reading = fed.feed((level,) * 6)
        assert (reading.saturated, reading.valid) == (False, True)


def test_a_sample_is_usable_up_to_the_stale_age_and_not_beyond() -> None:
    fed = Fed()
    for age_ns in (-1, 0, 1, STALE_NS // 2, STALE_NS - 1, STALE_NS, STALE_NS + 1, 100 * STALE_NS):
        reading = fed.look(age_ns)
        assert (reading.valid, reading.age_ns) == (0 <= age_ns <= STALE_NS, age_ns)


def test_the_last_good_wrench_is_kept_while_stale_and_replaced_by_the_next_sample() -> None:
    """A sample seen twice or out of order does not move it."""
    fed = Fed()
    before = fed.settle(x(20.0))
    for again_ns in (0, -PERIOD_NS):
        np.testing.assert_array_equal(fed.feed(x(999.0), again_ns).wrench, before.wrench)
    reading = fed.look(NS_PER_S)
    assert not reading.valid
    np.testing.assert_array_equal(reading.wrench, before.wrench)
    reading = fed.feed(legs((0, 9.0, 0, 0, 0, 0)), NS_PER_S)
    assert reading.valid
    np.testing.assert_allclose(reading.wrench, [0, 9.0, 0, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("taring", [True, False])
def test_a_force_that_is_not_finite_is_refused_and_counted(
    leg: int, number: float, taring: bool
) -> None:
    fed = Fed()
    if taring:
        fed.state = start_tare(fed.state)
        fed.feed(ZERO, 0)
    refused = fed.state.refused
    assert fed.feed(only(leg, number)).age_ns == PERIOD_NS, "it counts as no sample"
    assert fed.state.refused == refused + 1
    assert np.isfinite([fed.state.wrench, fed.state.tare_sum]).all()


samples = st.none() | st.tuples(*[st.floats(width=32)] * 6)


@given(
    stream=st.lists(st.tuples(st.integers(0, 40 * NS_PER_MS), samples), max_size=40),
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
