"""What goes wrong on this host beside the record: floods of the bus's ports, a disk that fills.

No other service has the time to look.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final

from services.recorder.disk_guard import MIB, DiskChange, SpaceGuard
from services.recorder.loop import Deadline, free_bytes_at
from shared.bus.sockets import Arrivals
from shared.clock import NS_PER_S

RUN_DIR_MIN_MIB: Final = 16
"""Free space below which the run directory is called full: its logs lose lines soon."""
_EVERY_NS: Final = 2 * NS_PER_S
_AGAIN_NS: Final = 10 * NS_PER_S
"""A flood that lasts is said so often."""


class HostWatch:
    """Looks every two seconds.

    Attributes:
        trouble: what is wrong with the run directory's disk, in words; empty if nothing is.
    """

    def __init__(
        self, arrivals: Arrivals, run_dir: Path, logger: logging.Logger, now_ns: int
    ) -> None:
        self._arrivals, self._run_dir, self._logger = arrivals, run_dir, logger
        self._guard = SpaceGuard(RUN_DIR_MIN_MIB)
        self._look = Deadline(_EVERY_NS, now_ns)
        self._say_at_ns = now_ns
        self.trouble = ""

    def look_if_due(self, now_ns: int) -> None:
        """Look, if it is time to, and say what there is to say."""
        if not self._look.passed(now_ns):
            return
        flood = self._arrivals.flood(now_ns)
        if flood and now_ns >= self._say_at_ns:
            self._say_at_ns = now_ns + _AGAIN_NS
            self._logger.warning("%s", flood)
        self._look_at_disk()

    def _look_at_disk(self) -> None:
        try:
            free = free_bytes_at(self._run_dir)
        except OSError as error:
            self.trouble = f"{self._run_dir}: {error.strerror}"
            return
        change = self._guard.feed(free)
        told = f"{self._run_dir}: {free // MIB} MiB free"
        self.trouble = "" if self._guard.enough else f"{told}: logs lose lines; free some space"
        if change in (DiskChange.LOW, DiskChange.FULL):
            self._logger.warning("%s: logs lose lines when it is full; free some space", told)
