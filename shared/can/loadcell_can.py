"""CAN frames of the load-cell amplifier: six leg forces in three frames.

Assumption: the paper names no amplifier. This is the simplest layout that a six-channel
CAN amplifier could have; a real one needs this file changed and nothing else.

    id 0x300   leg 0, leg 1   two float32, little-endian, N, tension positive
    id 0x301   leg 2, leg 3
    id 0x302   leg 4, leg 5

A sample is its three frames in this order with no other of them in between. The frames are full, so
there is no sample counter. A gap inside a sample breaks its order; the loss of exactly three frames
that straddle two samples is not detected.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import Vector6
from shared.can.frame_group import FrameGroup

FIRST_ID: Final = 0x300
FRAME_IDS: Final = (FIRST_ID, FIRST_ID + 1, FIRST_ID + 2)
FRAME_BYTES: Final = 8

_SAMPLE: Final = struct.Struct("<6f")
_FLOAT32: Final = struct.Struct("<f")


class LegSample(msgspec.Struct, frozen=True, gc=False):
    """Six leg forces of one moment."""

    t_ns: int
    """Monotonic time at which they were read from the link."""
    forces: Vector6
    """N, tension positive; may hold anything a float32 can, NaN included."""


def as_sent(force: float) -> float:
    """Return a force in N as it comes out of the frames, rounded to float32."""
    value: float = _FLOAT32.unpack(_FLOAT32.pack(force))[0]
    return value


def pack(forces: Sequence[float]) -> list[tuple[int, bytes]]:
    """Return the three frames (id, 8 bytes) of six leg forces in N."""
    data = _SAMPLE.pack(*forces)
    return [
        (can_id, data[FRAME_BYTES * index : FRAME_BYTES * (index + 1)])
        for index, can_id in enumerate(FRAME_IDS)
    ]


class SampleAssembler:
    """Makes samples of frames."""

    def __init__(self) -> None:
        self._group = FrameGroup([(can_id, FRAME_BYTES) for can_id in FRAME_IDS])

    @property
    def malformed(self) -> int:
        """Frames of the sensor that were of the wrong length or out of order."""
        return self._group.malformed

    def add(self, can_id: int, data: bytes | bytearray) -> Vector6 | None:
        """Take one frame; return six leg forces in N if it completes a sample.

        Frames of other ids are ignored.
        """
        sample = self._group.add(can_id, data)
        if sample is None:
            return None
        forces: Vector6 = _SAMPLE.unpack(sample)
        return forces

    def reset(self) -> None:
        """Forget a sample that is not complete: its rest belongs to another link."""
        self._group.reset()
