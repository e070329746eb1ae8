"""CAN frames of the IMU: the part of an Xsens MTi 600's protocol that is used.

The MTi is an AHRS with CAN: its orientation is good to 0.2 .. 0.5 degrees in roll and pitch. In the
MT Manager's CAN output, StatusWord, Quaternion and RateOfTurn are switched on, with standard
identifiers and the same rate; all is big-endian (MT CAN protocol, MT1604P).

    id 0x11   uint32      status; bit 1: the orientation is valid
    id 0x21   4 int16     quaternion w, x, y, z in 2^-15: sensor axes to (east, north, up)
    id 0x32   3 int16     rate of turn in 2^-9 rad/s, sensor axes

A sample is these frames in this order. Another IMU needs this file changed and nothing else.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import Vector3, Vector4
from shared.can.frame_group import FrameGroup, split

STATUS_ID: Final = 0x11
QUATERNION_ID: Final = 0x21
RATE_ID: Final = 0x32
VALID: Final = 0x2
"""Bit of the status word: the orientation is valid."""
SELF_TEST_OK: Final = 0x1

_QUATERNION_SCALE: Final = 2.0**15
_RATE_SCALE: Final = 2.0**9
_INT16: Final = (-(2**15), 2**15 - 1)
_SAMPLE: Final = struct.Struct(">I4h3h")
_FRAMES: Final = ((STATUS_ID, 4), (QUATERNION_ID, 8), (RATE_ID, 6))
IDS: Final = tuple(can_id for can_id, _ in _FRAMES)


class ImuSample(msgspec.Struct, frozen=True, gc=False):
    """One sample of the IMU."""

    quaternion: Vector4
    """w, x, y, z: turns sensor axes into axes whose z is up."""
    rate: Vector3
    """rad/s, sensor axes."""
    valid: bool


def pack(
    quaternion: Sequence[float], rate: Sequence[float], *, valid: bool
) -> list[tuple[int, bytes]]:
    """Return the three frames (id, data) of a sample; values out of range are clipped.

    The quaternion is w, x, y, z of unit length, the rate (3,) rad/s in sensor axes.
    """
    status = SELF_TEST_OK | (VALID if valid else 0)
    data = _SAMPLE.pack(
        status,
        *(_int16(part * _QUATERNION_SCALE) for part in quaternion),
        *(_int16(part * _RATE_SCALE) for part in rate),
    )
    return split(_FRAMES, data)


def _sample(data: bytes) -> ImuSample:
    status, w, x, y, z, a, b, c = _SAMPLE.unpack(data)
    q, r = _QUATERNION_SCALE, _RATE_SCALE
    return ImuSample((w / q, x / q, y / q, z / q), (a / r, b / r, c / r), bool(status & VALID))


class ImuAssembler(FrameGroup[ImuSample]):
    """Makes samples of frames."""

    def __init__(self) -> None:
        super().__init__(_FRAMES, _sample)


def _int16(value: float) -> int:
    low, high = _INT16
    return min(high, max(low, round(value)))
