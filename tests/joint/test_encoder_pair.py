"""Which estimates of two axes make a sample."""

from __future__ import annotations

import math
import random

import pytest

from services.joint.drivers.encoder_pair import EncoderPair

PERIOD_NS = 2_000_000
BEHIND_NS = 130_000
"""Axis1's frame comes after axis0's, back to back on a bus of 1 Mbit/s."""


def run(
    cycles: int,
    lost: set[tuple[int, int]],
    phase_ns: int = BEHIND_NS,
    jitter_ns: int = 0,
    period_ns: tuple[int, int] = (PERIOD_NS, PERIOD_NS),
) -> list[tuple[float, float]]:
    """Return the samples, as cycle numbers of (axis0, axis1); `lost` names (cycle, axis)."""
    dice = random.Random(1)
    frames = [
        (10**9 + k * period_ns[axis] + axis * phase_ns + dice.randint(0, jitter_ns), k, axis)
        for k in range(cycles)
        for axis in (0, 1)
        if (k, axis) not in lost
    ]
    pair = EncoderPair()
    samples = []
    for now_ns, k, axis in sorted(frames):
        pair.take(axis, (float(k), 0.0), now_ns)
        if pair.complete():
            (a, _), (b, _) = pair.estimates
            samples.append((a, b))
    return samples


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("cycle", [3, 4])
def test_after_a_lost_frame_the_axes_are_of_the_same_period_again(cycle: int, axis: int) -> None:
    samples = run(20, {(cycle, axis)})
    torn = [sample for sample in samples if sample[0] != sample[1]]
    assert len(torn) <= 1
    assert samples[-10:] == [(float(k), float(k)) for k in range(10, 20)]


def test_without_loss_every_period_makes_one_sample() -> None:
    assert run(50, set()) == [(float(k), float(k)) for k in range(50)]


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45, 0.5, 0.55, 0.7, 0.95])
def test_axes_out_of_step_make_as_many_samples_and_the_tightest(share: float) -> None:
    """As two boards of firmware 0.6 are, each with its own clock."""
    samples = run(200, set(), round(share * PERIOD_NS), jitter_ns=PERIOD_NS // 50)
    assert len(samples) >= 190
    if share < 0.4:
        assert all(a == b for a, b in samples[5:])
    if share > 0.6:
        assert all(a == b + 1 for a, b in samples[5:])


def test_axes_whose_clocks_drift_past_each_other_never_stop_making_samples() -> None:
    slow = round(1.01 * PERIOD_NS)
    assert len(run(1000, set(), period_ns=(PERIOD_NS, slow))) >= 970


def test_frames_that_waited_together_make_a_sample_of_the_newest() -> None:
    pair = EncoderPair()
    for k in range(5):
        for axis in (0, 1):
            pair.take(axis, (float(k), 0.0), 10**9)
    assert pair.complete()
    assert not pair.complete()
    assert pair.estimates == [(4.0, 0.0), (4.0, 0.0)]


@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.0, math.inf)])
def test_what_is_no_number_is_no_estimate(bad: tuple[float, float]) -> None:
    pair = EncoderPair()
    pair.take(0, (1.0, 2.0), 10**9)
    pair.take(1, bad, 10**9)
    assert not pair.complete()
    assert pair.estimates == [(1.0, 2.0), (0.0, 0.0)]
