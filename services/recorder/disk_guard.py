"""When the disk is too full to go on recording. Pure.

Nothing is ever deleted. Below the least free space the file is finished while there is
still room for its end, and recording waits; once there is clearly more again it goes on
with the run's next file. A run that is stopped here does not end the recorder.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

MIB: Final = 1 << 20

WARN: Final = 2.0
"""Multiple of the least free space below which it warns."""
RESUME: Final = 1.5
"""Multiple of the least free space above which recording resumes."""
CALM: Final = 2.5
"""Multiple of the least free space above which the next warning is new."""


class DiskChange(Enum):
    """Change at the newest look at the disk."""

    NONE = 0
    LOW = 1
    FULL = 2
    BACK = 3


class SpaceGuard:
    """Feed it the free space once in a while; a least free space of 0 switches it off."""

    def __init__(self, least_mib: float) -> None:
        self.enough = True
        """Recording may go on."""
        self._least = least_mib * MIB
        self._warned = False

    def feed(self, free_bytes: int) -> DiskChange:
        """Take the free space; return what changes by it."""
        if not self._least:
            return DiskChange.NONE
        if self.enough and free_bytes < self._least:
            self.enough, self._warned = False, True
            return DiskChange.FULL
        if not self.enough:
            if free_bytes < RESUME * self._least:
                return DiskChange.NONE
            self.enough = True
            return DiskChange.BACK
        if free_bytes >= CALM * self._least:
            self._warned = False
        if not self._warned and free_bytes < WARN * self._least:
            self._warned = True
            return DiskChange.LOW
        return DiskChange.NONE
