from __future__ import annotations

import itertools
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.can.loadcell_can import FRAME_IDS, SampleAssembler, as_sent, pack

float32 = st.floats(width=32, allow_nan=False)
ONE = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
TWO = (-1.0, -2.0, -3.0, -4.0, -5.0, -6.0)


@given(forces=st.tuples(*[float32] * 6))
def test_forces_come_out_of_the_frames_as_they_went_in(forces: tuple[float, ...]) -> None:
    assembler = SampleAssembler()
    results = [assembler.add(can_id, data) for can_id, data in pack(forces)]
    assert results == [None, None, forces]
    assert assembler.malformed == 0


def test_layout_is_two_little_endian_float32_per_frame() -> None:
    assert pack(ONE) == [
        (0x300, struct.pack("<ff", 1.0, 2.0)),
        (0x301, struct.pack("<ff", 3.0, 4.0)),
        (0x302, struct.pack("<ff", 5.0, 6.0)),
    ]


def test_a_nan_is_carried_for_the_filter_to_refuse() -> None:
    assembler = SampleAssembler()
    results = [assembler.add(*frame) for frame in pack((math.nan, *ONE[1:]))]
    assert results[2] is not None
    assert math.isnan(results[2][0])


@pytest.mark.parametrize("lost", [c for n in (1, 2, 3) for c in itertools.combinations(range(6), n)
                                  if c != (1, 2, 3) and c != (2, 3, 4)])  # fmt: skip
def test_frames_of_two_samples_are_never_mixed_when_some_are_lost(lost: tuple[int, ...]) -> None:
    """All losses but the two that leave three frames in order, which the docs name."""
    frames = [frame for n, frame in enumerate(pack(ONE) + pack(TWO)) if n not in lost]
    assembler = SampleAssembler()
    results = [assembler.add(*frame) for frame in frames]
    assert {result for result in results if result is not None} <= {ONE, TWO}
    recovered = [assembler.add(*frame) for frame in pack(ONE)]
    assert recovered[2] == ONE


def test_frames_of_the_wrong_length_are_counted_and_end_the_sample() -> None:
    assembler = SampleAssembler()
    (a, first), (b, second), (c, third) = pack(ONE)
    assert assembler.add(a, first) is None
    assert assembler.add(b, second[:7]) is None
    assert assembler.add(c, third) is None
    assert assembler.malformed == 2


def test_a_frame_of_the_wrong_length_is_not_made_good_by_another_sample() -> None:
    assembler = SampleAssembler()
    first, (can_id, second), _ = pack(ONE)
    frames = [first, (can_id, second[:7]), *pack(TWO)[1:]]
    assert [assembler.add(*frame) for frame in frames] == [None] * 4


@pytest.mark.parametrize("foreign", [0, FRAME_IDS[0] - 1, FRAME_IDS[2] + 1, 0x7FF])
def test_foreign_frames_are_ignored_between_those_of_a_sample(foreign: int) -> None:
    assembler = SampleAssembler()
    results = [
        result
        for frame in pack(ONE)
        for result in (assembler.add(foreign, b"\0" * 8), assembler.add(*frame))
    ]
    assert results[-1] == ONE
    assert assembler.malformed == 0


def test_a_partial_sample_is_forgotten_on_reset() -> None:
    assembler = SampleAssembler()
    first, second, third = pack(ONE)
    assembler.add(*first)
    assembler.add(*second)
    assembler.reset()
    assert assembler.add(*third) is None


@given(force=st.floats(-1e5, 1e5))
def test_as_sent_is_what_comes_out_of_a_frame(force: float) -> None:
    assembler = SampleAssembler()
    results = [assembler.add(*frame) for frame in pack((force,) * 6)]
    assert results[2] == (as_sent(force),) * 6
