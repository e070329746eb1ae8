"""Samples that a CAN sensor sends as a fixed sequence of frames."""

from __future__ import annotations

from collections.abc import Sequence


class FrameGroup:
    """Puts the frames of a sample together; never mixes frames across a gap.

    A sample is its frames in order with no other of them in between.
    """

    def __init__(self, frames: Sequence[tuple[int, int]]) -> None:
        """Take (id, bytes) of each frame, in the order in which they are sent."""
        self.malformed = 0
        """Frames of the sensor that were of the wrong length or out of order."""
        self._index = {can_id: index for index, (can_id, _) in enumerate(frames)}
        self._bytes = [size for _, size in frames]
        self._last = len(frames) - 1
        self._data = bytearray()
        self._next = 0

    def add(self, can_id: int, data: bytes | bytearray) -> bytes | None:
        """Take one frame; return the sample's bytes if it completes one.

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
        return bytes(self._data)

    def reset(self) -> None:
        """Forget a sample that is not complete: its rest belongs to another link."""
        self._next = 0
