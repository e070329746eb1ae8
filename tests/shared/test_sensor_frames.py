"""CAN frames of load cells and IMU: their layouts, and samples that are never mixed."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.can import imu_can, loadcell_can
from shared.can.frame_group import FrameGroup
from shared.can.imu_can import ImuAssembler, ImuSample
from shared.can.loadcell_can import FRAME_IDS, SampleAssembler, as_sent

Frames = list[tuple[int, bytes]]
ONE = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
TWO = (-1.0, -2.0, -3.0, -4.0, -5.0, -6.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
part, float32 = st.floats(-1.0, 1.0), st.floats(width=32, allow_nan=False)


class Kind(NamedTuple):
    """A sensor, and two samples of it that survive their frames."""

    assembler: Callable[[], FrameGroup[Any]]
    one: Frames
    two: Frames
    lost_unseen: tuple[tuple[int, ...], ...] = ()
    """Losses of frames that leave a sample's frames in order; the docs name them."""

    def samples(self) -> list[Any]:
        return [added(self.assembler(), frames)[-1] for frames in (self.one, self.two)]


KINDS = {
    "load cells": Kind(
        SampleAssembler, loadcell_can.pack(ONE), loadcell_can.pack(TWO), ((1, 2, 3), (2, 3, 4))
    ),
    "IMU": Kind(
        ImuAssembler,
        imu_can.pack((0.5, 0.5, 0.5, 0.5), (1.0, 2.0, 3.0), valid=True),
        imu_can.pack((0.5, -0.5, 0.5, -0.5), (3.0, 2.0, 1.0), valid=False),
        ((1, 2, 3), (2, 3, 4)),
    ),
}
each_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def added(assembler: FrameGroup[Any], frames: Frames) -> list[Any]:
    return [assembler.add(*frame) for frame in frames]


def test_the_layouts_are_those_of_the_protocols() -> None:
    """By hand: two little-endian float32 a frame; w = 1 clips to 0x7FFF, 1 rad/s is 0x0200."""
    assert KINDS["load cells"].one == [
        (can_id, struct.pack("<ff", *ONE[2 * n : 2 * n + 2]))
        for n, can_id in enumerate((0x300, 0x301, 0x302))
    ]
    assert imu_can.pack(LEVEL, (1.0, 0.0, -1.0), valid=True) == [
        (0x11, bytes.fromhex("00000003")),
        (0x21, bytes.fromhex("7FFF000000000000")),
        (0x32, bytes.fromhex("02000000FE00")),
    ]
    assert imu_can.IDS == (0x11, 0x21, 0x32)


@given(st.tuples(*[float32] * 6), st.floats(-1e5, 1e5))
def test_forces_come_out_of_the_frames_as_they_went_in(
    forces: tuple[float, ...], any_force: float
) -> None:
    assembler = SampleAssembler()
    assert added(assembler, loadcell_can.pack(forces)) == [None, None, forces]
    sent = added(assembler, loadcell_can.pack((any_force,) * 6))[2]
    assert sent == (as_sent(any_force),) * 6
    assert assembler.malformed == 0


def test_a_nan_is_carried_for_the_filter_to_refuse() -> None:
    assert math.isnan(added(SampleAssembler(), loadcell_can.pack((math.nan, *ONE[1:])))[2][0])


@given(st.tuples(part, part, part, part), st.tuples(*[st.floats(-60.0, 60.0)] * 3), st.booleans())
def test_an_attitude_comes_back_as_it_was_sent_but_for_rounding(
    quaternion: tuple[float, ...], rate: tuple[float, ...], valid: bool
) -> None:
    sample: ImuSample = added(ImuAssembler(), imu_can.pack(quaternion, rate, valid=valid))[2]
    assert sample.quaternion == pytest.approx(quaternion, abs=2.0**-15)
    assert sample.rate == pytest.approx(rate, abs=2.0**-10)
    assert sample.valid is valid


def test_a_rate_out_of_range_is_clipped() -> None:
    sample = added(ImuAssembler(), imu_can.pack(LEVEL, (1e3, -1e3, math.pi), valid=True))[2]
    assert sample.rate == pytest.approx((64.0, -64.0, math.pi), abs=2.0**-8)


@each_kind
@pytest.mark.parametrize("count", [1, 2, 3])
def test_frames_of_two_samples_are_never_mixed_when_some_are_lost(kind: Kind, count: int) -> None:
    frames, (one, two) = kind.one + kind.two, kind.samples()
    for lost in set(itertools.combinations(range(6), count)) - set(kind.lost_unseen):
        assembler = kind.assembler()
        came = added(assembler, [frame for n, frame in enumerate(frames) if n not in lost])
        assert all(sample in (None, one, two) for sample in came), lost
        assert added(assembler, kind.one)[2] == one


@each_kind
def test_a_frame_of_the_wrong_length_ends_the_sample_and_no_other_makes_it_good(kind: Kind) -> None:
    assembler = kind.assembler()
    first, (can_id, second), third = kind.one
    assert added(assembler, [first, (can_id, second[:-1]), third]) == [None] * 3
    assert assembler.malformed == 2
    assert added(kind.assembler(), [first, (can_id, second[:-1]), *kind.two[1:]]) == [None] * 4


@each_kind
@pytest.mark.parametrize("foreign", [0, FRAME_IDS[0] - 1, FRAME_IDS[2] + 1, 0x7FF])
def test_foreign_frames_are_ignored_between_those_of_a_sample(kind: Kind, foreign: int) -> None:
    assembler = kind.assembler()
    came = added(assembler, [f for own in kind.one for f in ((foreign, bytes(8)), own)])
    assert (came[-1], assembler.malformed) == (kind.samples()[0], 0)
