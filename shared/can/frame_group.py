"""Samples that a CAN sensor sends as a fixed sequence of frames. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

S = TypeVar("S")


def split(frames: Sequence[tuple[int, int]], data: bytes) -> list[tuple[int, bytes]]:
    """Return the frames (id, data) of a sample's bytes; `frames` has (id, bytes) of each."""
    found, begin = [], 0
    for can_id, size in frames:
        found.append((can_id, data[begin : begin + size]))
        begin += size
    return found


class FrameGroup(Generic[S]):
    """Puts the frames of a sample together; never mixes frames across a gap.

    A sample is its frames, (id, bytes) of each, in this order with no other of them in between;
    `unpack` makes it of their bytes.
    """

    def __init__(self, frames: Sequence[tuple[int, int]], unpack: Callable[[bytes], S]) -> None:
        self.malformed = 0
        """Frames of the sensor that were of the wrong length or out of order."""
        self._unpack = unpack
        self._index = {can_id: index for index, (can_id, _) in enumerate(frames)}
        self._bytes = [size for _, size in frames]
        self._last = len(frames) - 1
        self._data = bytearray()
        self._next = 0

    def add(self, can_id: int, data: bytes | bytearray) -> S | None:
        """Take one frame; return the sample that it completes, or None.

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
        """Forget a sample that is not complete: its rest belongs to another link."""
        self._next = 0
