"""Watches the free disk space of the recorder's host, and which tools are linked.

No other service has time for this. Below the minimum free space, the recorder finishes its file
while there is room for the file's end, and pauses; it deletes nothing. Once there is clearly more
space, it continues with the run's next file.
"""

from __future__ import annotations

import logging
import os
from enum import Enum
from pathlib import Path
from typing import Final

from shared.bus import topics
from shared.bus.messages import ToolRoster
from shared.bus.session import Session
from shared.clock import NS_PER_MS, NS_PER_S

MIB: Final = 1 << 20

WARN: Final = 2.0
"""Multiple of the minimum free space below which the recorder warns."""
RESUME: Final = 1.5
"""Multiple of the minimum free space above which recording resumes."""
CALM: Final = 2.5
"""Multiple of the minimum free space above which the next shortage causes a new warning."""
RUN_DIR_MIN_MIB: Final = 16
"""Free space below which the run directory counts as full, MiB: its logs soon lose lines."""
_EVERY_NS: Final = 2 * NS_PER_S


class DiskChange(Enum):
    """Change that the newest disk check found."""

    NONE = 0
    LOW = 1
    FULL = 2
    BACK = 3


class SpaceGuard:
    """Compares the free space with a minimum; a minimum of 0 switches the guard off."""

    def __init__(self, least_mib: float) -> None:
        self.enough = True
        """True while recording may continue."""
        self._least = least_mib * MIB
        self._warned = False

    def feed(self, free_bytes: int) -> DiskChange:
        """Update with the free space; return the change."""
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


def free_bytes_at(directory: Path) -> int:
    """Return the free bytes where a directory is or will be; raise OSError if they are unknown."""
    while not directory.exists() and directory != directory.parent:
        directory = directory.parent
    found = os.statvfs(directory)
    return found.f_bavail * found.f_frsize


class Deadline:
    """Periodic deadline."""

    def __init__(self, period_ns: int, now: int) -> None:
        self._period_ns = period_ns
        self._due_ns = now + period_ns

    def passed(self, now: int) -> bool:
        """Return True, and start the next period, if the current period is over."""
        if now < self._due_ns:
            return False
        self._due_ns = now + self._period_ns
        return True


class RunDirWatch:
    """Checks the disk of the run directory every two seconds."""

    def __init__(self, run_dir: Path, logger: logging.Logger, now_ns: int) -> None:
        self._run_dir, self._logger = run_dir, logger
        self._guard = SpaceGuard(RUN_DIR_MIN_MIB)
        self._due = Deadline(_EVERY_NS, now_ns)
        self.trouble = ""
        """Problem with the run directory's disk; empty if there is none."""

    def check_if_due(self, now_ns: int) -> None:
        """Check the disk if that is due, and log a warning if its free space is low."""
        if not self._due.passed(now_ns):
            return
        try:
            free = free_bytes_at(self._run_dir)
        except OSError as error:
            self.trouble = f"{self._run_dir}: {error.strerror}"
            return
        change = self._guard.feed(free)
        left = f"{self._run_dir}: {free // MIB} MiB free"
        self.trouble = "" if self._guard.enough else f"{left}: logs lose lines; free some space"
        if change in (DiskChange.LOW, DiskChange.FULL):
            self._logger.warning("%s: logs lose lines on a full disk; free some space", left)


NEWS_NS: Final = 100 * NS_PER_MS
"""Minimum time between two messages, ns, however many tools connect or leave."""


class Roster:
    """Publishes the linked tools and the recording's problems twice a second and at each change.

    `xrl status` shows them. Every tool connects to the recorder, so the list is complete.
    """

    def __init__(self, session: Session) -> None:
        self._watch = session.linked_tools()
        self._publisher = session.publisher(topics.TOOLS, ToolRoster)
        self._sent: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
        self._sent_ns = self._due_ns = 0
        self._seq = 0

    def put_if_due(self, now_ns: int, trouble: tuple[str, ...]) -> None:
        """Publish linked tools and problems if they changed or are due again; never blocks."""
        news = self._watch.names(), trouble
        is_news = news != self._sent and now_ns >= self._sent_ns + NEWS_NS
        if not is_news and now_ns < self._due_ns:
            return
        self._sent_ns = now_ns
        self._sent, self._due_ns = news, now_ns + round(NS_PER_S / topics.TOOLS.rate_hz)
        self._seq += 1
        self._publisher.put(ToolRoster(t_ns=now_ns, seq=self._seq, tools=news[0], trouble=trouble))
