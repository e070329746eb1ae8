from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.can.imu_can import IDS, ImuAssembler, ImuSample, pack

LEVEL = (1.0, 0.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)
parts = st.floats(-1.0, 1.0)
rates = st.tuples(*[st.floats(-60.0, 60.0)] * 3)


def assembled(frames: list[tuple[int, bytes]]) -> list[ImuSample]:
    assembler = ImuAssembler()
    found = [assembler.add(can_id, data) for can_id, data in frames]
    return [sample for sample in found if sample is not None]


def test_the_frames_are_those_of_the_protocol() -> None:
    """By hand from its scaling: w = 1 clips to 0x7FFF, 1 rad/s is 0x0200; big-endian."""
    frames = pack(LEVEL, (1.0, 0.0, -1.0), valid=True)
    assert frames == [
        (0x11, bytes.fromhex("00000003")),
        (0x21, bytes.fromhex("7FFF000000000000")),
        (0x32, bytes.fromhex("02000000FE00")),
    ]
    assert tuple(can_id for can_id, _ in frames) == IDS


@given(st.tuples(parts, parts, parts, parts), rates, st.booleans())
def test_a_sample_comes_back_as_it_was_sent_but_for_rounding(
    quaternion: tuple[float, float, float, float], rate: tuple[float, float, float], valid: bool
) -> None:
    (sample,) = assembled(pack(quaternion, rate, valid=valid))
    assert sample.quaternion == pytest.approx(quaternion, abs=2.0**-15)
    assert sample.rate == pytest.approx(rate, abs=2.0**-10)
    assert sample.valid is valid


@pytest.mark.parametrize("lost", range(len(IDS)))
def test_a_sample_that_lacks_a_frame_is_none_and_the_next_one_is(lost: int) -> None:
    frames = pack(LEVEL, STILL, valid=True)
    cut = frames[:lost] + frames[lost + 1 :]
    whole = pack(LEVEL, (1.0, 2.0, 3.0), valid=True)
    assert assembled(cut) == []
    assert [sample.rate for sample in assembled(cut + whole)] == [(1.0, 2.0, 3.0)]


def test_frames_of_the_wrong_length_and_of_others_make_no_sample() -> None:
    assembler = ImuAssembler()
    (a, status), (b, quaternion), (c, rate) = pack(LEVEL, STILL, valid=True)
    assert assembler.add(a, status) is None
    assert assembler.add(b, quaternion[:-1]) is None
    assert assembler.add(c, rate) is None
    assert assembler.malformed == 2
    assert assembler.add(0x300, bytes(8)) is None
    assert assembler.malformed == 2


def test_what_is_out_of_range_is_clipped() -> None:
    (sample,) = assembled(pack(LEVEL, (1e3, -1e3, math.pi), valid=True))
    assert sample.rate == pytest.approx((64.0, -64.0, math.pi), abs=2.0**-8)
