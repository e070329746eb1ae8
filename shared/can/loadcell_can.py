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

from shared.bus.messages import Vector6
from shared.can.frame_group import FrameGroup, split

FIRST_ID: Final = 0x300
FRAME_IDS: Final = (FIRST_ID, FIRST_ID + 1, FIRST_ID + 2)
_FRAMES: Final = tuple((can_id, 8) for can_id in FRAME_IDS)

_SAMPLE: Final = struct.Struct("<6f")
_FLOAT32: Final = struct.Struct("<f")


def as_sent(force: float) -> float:
    """Return a force in N as it comes out of the frames, rounded to float32."""
    value: float = _FLOAT32.unpack(_FLOAT32.pack(force))[0]
    return value


def pack(forces: Sequence[float]) -> list[tuple[int, bytes]]:
    """Return the three frames (id, 8 bytes) of six leg forces in N."""
    return split(_FRAMES, _SAMPLE.pack(*forces))


class SampleAssembler(FrameGroup[Vector6]):
    """Makes samples of frames: six leg forces of one moment, N, tension positive.

    They may be anything that a float32 can, NaN included.
    """

    def __init__(self) -> None:
        super().__init__(_FRAMES, _SAMPLE.unpack)
