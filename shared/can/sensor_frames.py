"""CAN frames of the load cells and of the IMU: samples as fixed sequences of frames. Pure.

For another amplifier or IMU, change only its part of this file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

import msgspec

from shared.bus.messages import Vector3, Vector4, Vector6

S = TypeVar("S")


def split(frames: Sequence[tuple[int, int]], data: bytes) -> list[tuple[int, bytes]]:
    """Return a sample's bytes as frames (id, data); `frames` has the id and size of each."""
    found, begin = [], 0
    for can_id, size in frames:
        found.append((can_id, data[begin : begin + size]))
        begin += size
    return found


class FrameGroup(Generic[S]):
    """Assembler of a sample's frames; discards a sample whose frames are out of order.

    A sample consists of the frames (id, number of bytes) in this order, each once; `unpack`
    converts their joined bytes.
    """

    def __init__(self, frames: Sequence[tuple[int, int]], unpack: Callable[[bytes], S]) -> None:
        self.malformed = 0
        """Number of sensor frames of a wrong length or out of order."""
        self._unpack = unpack
        self._index = {can_id: index for index, (can_id, _) in enumerate(frames)}
        self._bytes = [size for _, size in frames]
        self._last = len(frames) - 1
        self._data = bytearray()
        self._next = 0

    def add(self, can_id: int, data: bytes | bytearray) -> S | None:
        """Add one frame; return the sample that it completes, or None.

        Frames of other ids are ignored.
        """
        index = self._index.get(can_id)
        if index is None:
            return None
        if len(data) != self._bytes[index]:
            self.malformed += 1
            self._next = 0
            return None
        if index != self._next:
            self.malformed += 1
            if index != 0:
                self._next = 0
                return None
        if index == 0:
            self._data.clear()
        self._data += data
        if index < self._last:
            self._next = index + 1
            return None
        self._next = 0
        return self._unpack(bytes(self._data))

    def reset(self) -> None:
        """Discard an incomplete sample, whose remaining frames were lost."""
        self._next = 0


FIRST_ID: Final = 0x300
LOADCELL_IDS: Final = (FIRST_ID, FIRST_ID + 1, FIRST_ID + 2)
_LOADCELL_FRAMES: Final = tuple((can_id, 8) for can_id in LOADCELL_IDS)

_FORCES: Final = struct.Struct("<6f")
_FLOAT32: Final = struct.Struct("<f")


def as_sent(force: float) -> float:
    """Return a force in N, rounded to float32 as in the frames."""
    value: float = _FLOAT32.unpack(_FLOAT32.pack(force))[0]
    return value


def pack_forces(forces: Sequence[float]) -> list[tuple[int, bytes]]:
    """Return the three frames (id, 8 bytes) of six leg forces in N."""
    return split(_LOADCELL_FRAMES, _FORCES.pack(*forces))


class SampleAssembler(FrameGroup[Vector6]):
    """Assembler of the load-cell amplifier's frames: six leg forces at one time.

    Assumption: the paper names no amplifier. This is the simplest layout that a six-channel CAN
    amplifier could have.

        id 0x300   leg 0, leg 1   two float32, little-endian, N, tension positive
        id 0x301   leg 2, leg 3
        id 0x302   leg 4, leg 5

    A force may have any float32 value, including NaN. The frames are full, so there is no sample
    counter. A gap inside a sample breaks its order; the loss of exactly three frames that straddle
    two samples is not detected.
    """

    def __init__(self) -> None:
        super().__init__(_LOADCELL_FRAMES, _FORCES.unpack)


STATUS_ID: Final = 0x11
QUATERNION_ID: Final = 0x21
RATE_ID: Final = 0x32
VALID: Final = 0x2
"""Bit of the status word: the orientation is valid."""
SELF_TEST_OK: Final = 0x1

_QUATERNION_SCALE: Final = 2.0**15
_RATE_SCALE: Final = 2.0**9
_INT16: Final = (-(2**15), 2**15 - 1)
_IMU: Final = struct.Struct(">I4h3h")
_IMU_FRAMES: Final = ((STATUS_ID, 4), (QUATERNION_ID, 8), (RATE_ID, 6))
IMU_IDS: Final = tuple(can_id for can_id, _ in _IMU_FRAMES)


class ImuSample(msgspec.Struct, frozen=True, gc=False):
    """One sample of the IMU."""

    quaternion: Vector4
    """w, x, y, z: rotates vectors from sensor axes to axes whose z is up."""
    rate: Vector3
    """rad/s, sensor axes."""
    valid: bool


def pack_imu(
    quaternion: Sequence[float], rate: Sequence[float], *, valid: bool
) -> list[tuple[int, bytes]]:
    """Return the three frames (id, data) of a sample; values out of range are clipped.

    The quaternion is w, x, y, z of unit length, the rate (3,) rad/s in sensor axes.
    """
    status = SELF_TEST_OK | (VALID if valid else 0)
    data = _IMU.pack(
        status,
        *(_int16(part * _QUATERNION_SCALE) for part in quaternion),
        *(_int16(part * _RATE_SCALE) for part in rate),
    )
    return split(_IMU_FRAMES, data)


def _imu_sample(data: bytes) -> ImuSample:
    status, w, x, y, z, a, b, c = _IMU.unpack(data)
    q, r = _QUATERNION_SCALE, _RATE_SCALE
    return ImuSample((w / q, x / q, y / q, z / q), (a / r, b / r, c / r), bool(status & VALID))


class ImuAssembler(FrameGroup[ImuSample]):
    """Assembler of an Xsens MTi 600's frames: the part of its protocol that is used.

    The MTi is an AHRS with CAN; its roll and pitch are accurate to 0.2 .. 0.5 degrees. In the MT
    Manager's CAN output, switch on StatusWord, Quaternion and RateOfTurn, with standard identifiers
    and the same rate. All values are big-endian (MT CAN protocol, MT1604P).

        id 0x11   uint32      status; bit 1: the orientation is valid
        id 0x21   4 int16     quaternion w, x, y, z in 2^-15: sensor axes to (east, north, up)
        id 0x32   3 int16     rate of turn in 2^-9 rad/s, sensor axes
    """

    def __init__(self) -> None:
        super().__init__(_IMU_FRAMES, _imu_sample)


def _int16(value: float) -> int:
    low, high = _INT16
    return min(high, max(low, round(value)))
