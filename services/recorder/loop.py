"""Cycles of the recorder: write, flush, sync, split, watch the disk."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final, Protocol

from services.recorder.host_watch import MIB, Deadline, DiskChange, SpaceGuard
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import RecorderConfig
from shared.exceptions import RunError
from shared.mcap_log.writer import FilePlace, MessageSource, RunWriter

_AT_ONCE: Final = 65_536
"""Maximum messages written in one cycle; the rest waits for the next."""

REPORT_PERIOD_S: Final = 10.0


class _BusSource(MessageSource, Protocol):
    """The recorder's stream of messages from the bus."""

    misdelivered: int
    """Messages that were dropped because they were not sent to the key that they arrived under."""


FreeBytes = Callable[[], int]


class Recorder:
    """Moves messages from the bus into files, in cycles of 20 ms."""

    def __init__(
        self,
        source: _BusSource,
        writer: RunWriter,
        config: RecorderConfig,
        logger: logging.Logger,
        *,
        free_bytes: FreeBytes,
        now_ns: int,
    ) -> None:
        """Check the disk, and start the first file.

        `writer` must not have started a file; `free_bytes` returns the free space where the run is
        written. Like all methods, this one raises RunError if a file cannot be written.
        """
        self._source, self._writer = source, writer
        self._logger, self._free_bytes = logger, free_bytes
        self._config = config
        self._guard = SpaceGuard(config.free_min_mib)
        self._flush = Deadline(int(config.flush_ms * NS_PER_MS), now_ns)
        self._sync = Deadline(int(config.fsync_s * NS_PER_S), now_ns)
        self._report = Deadline(int(REPORT_PERIOD_S * NS_PER_S), now_ns)
        self._begun_ns = now_ns
        self.removed_files = self.removed_messages = 0
        """Number of files that were removed while being written, and of the messages in them."""
        self._why_next = ""
        """Reason to start a new file as soon as possible; "" without one."""
        self._reported_unwritable = False
        self.trouble = ""
        """Reason why nothing is recorded; "" while recording."""
        self._watch_space()
        self._begin(now_ns, {})

    def cycle(self, now_ns: int) -> None:
        """Write new messages; flush, sync, split and report when due."""
        self._writer.take_from(self._source, _AT_ONCE)
        flush = self._flush.passed(now_ns)
        if self._sync.passed(now_ns):  # flushes as well
            self._writer.sync()
            self._watch_space()
        elif flush:
            self._writer.flush()
        if flush:
            self._watch_file(now_ns)
            self._split_if_due(now_ns)
        if self._report.passed(now_ns):
            self._logger.info("%s", summary(self._writer, self._source))

    def _begin(self, now_ns: int, note: dict[str, str]) -> None:
        if self._guard.enough:
            self._begun_ns = now_ns
            self._writer.begin(note)

    def _split_if_due(self, now_ns: int) -> None:
        if not self._writer.recording:
            return
        seconds, size = self._config.split_s, self._config.split_mib * MIB
        old = seconds and now_ns - self._begun_ns >= seconds * NS_PER_S
        if old or (size and self._writer.size >= size):
            before = self._writer.path
            self._writer.finish()
            self._begin(now_ns, {"why": "time" if old else "size"})
            self._logger.info("%s is finished; continuing in %s", before, self._writer.path)

    def _watch_file(self, now_ns: int) -> None:
        """Start the next file, if one is due and there is space for it."""
        self._leave_if_gone()
        if not self._why_next or not self._guard.enough:
            return
        try:
            self._begin(now_ns, {"why": self._why_next})
        except RunError as error:
            if not self._reported_unwritable:
                self._logger.error("%s; retrying", error)
            self._reported_unwritable, self.trouble = True, f"not recorded: {error}"
            return
        self._why_next, self._reported_unwritable, self.trouble = "", False, ""
        left_out = self._writer.left_out
        self._logger.warning(
            "recording continues in %s; messages left out so far: %d", self._writer.path, left_out
        )

    def _leave_if_gone(self) -> None:
        """Log that the file was moved or deleted; a moved file is finished at its new place."""
        place = self._writer.where_is_file
        if place is FilePlace.THERE:
            return
        path, count = self._writer.path, self._writer.messages_in_file
        self._writer.finish()
        if place is FilePlace.REMOVED:
            self.removed_files += 1
            self.removed_messages += count
        self._logger.error(
            "%s was %s while being written, with %d messages", path, place.value, count
        )
        self._why_next = f"the previous file was {place.value}"

    def _watch_space(self) -> None:
        """Pause recording before the disk is full, and continue once there is space."""
        try:
            free = self._free_bytes()
        except OSError:  # the next write reports it
            return
        where, least = self._writer.path.parent, self._config.free_min_mib
        match self._guard.feed(free):
            case DiskChange.LOW:
                self._logger.warning(
                    "%s: %d MiB free; recording stops below %d MiB (recorder.free_min_mib); "
                    "free some space",
                    where, free // MIB, least,
                )  # fmt: skip
            case DiskChange.FULL:
                self._writer.finish()
                self.trouble = (
                    f"{where}: {free // MIB} MiB free, less than recorder.free_min_mib = {least}: "
                    "recording has stopped; it continues when there is space again"
                )
                self._logger.error("%s", self.trouble)
            case DiskChange.BACK:
                self.trouble = ""
                self._logger.warning("%s: %d MiB free again", where, free // MIB)
                self._why_next = self._why_next or "space again"
            case DiskChange.NONE:
                pass

    def close(self) -> None:
        """Write the messages that are still queued; the writer finishes the file."""
        self._writer.take_from(self._source, _AT_ONCE)
        self._leave_if_gone()


def summary(writer: RunWriter, source: _BusSource) -> str:
    """Return the counts in one line."""
    counts = writer.counts.values()
    line = (
        f"{writer.messages} messages on {sum(1 for c in counts if c.count)} keys, "
        f"{sum(c.missing for c in counts)} missing in {sum(c.gaps for c in counts)} gaps, "
        f"{sum(c.restarts for c in counts)} restarts"
    )
    if writer.begun > 1:
        line += f", {writer.begun} files"
    for what, keys in (("unknown keys", writer.unknown), ("malformed", writer.malformed)):
        if keys:
            line += f"; {sum(keys.values())} left out, {what}: {', '.join(sorted(keys))}"
    if source.misdelivered:
        line += f"; {source.misdelivered} left out, delivered under another key"
    if writer.left_out:
        line += f"; {writer.left_out} left out while no file could be written"
    return line
