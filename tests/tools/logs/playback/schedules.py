"""Schedules of messages that a test makes up."""

from __future__ import annotations

from collections.abc import Sequence

from shared.clock import NS_PER_S
from tools.logs.playback.schedule import Entry, EntryStream, Schedule, Window


def schedule_of(rows: Sequence[Entry], part: Window, *, loop: bool) -> Schedule:
    """Return a schedule that reads its messages in blocks of a second."""
    stream = EntryStream(
        lambda begin_ns, end_ns: [row for row in rows if begin_ns <= row.time_ns < end_ns],
        part,
        block_ns=NS_PER_S,
    )
    return Schedule(stream, part, loop=loop)
