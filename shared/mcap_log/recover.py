"""Recovers a file that was never finished: a copy with the index that every reader needs.

The original stays until the copy is complete and on the disk; a
recovery that is killed leaves the original as it was, and the next one starts over.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Final, TypeAlias

import msgspec
from mcap.opcode import Opcode
from mcap.records import Metadata

from shared.atomic_file import atomic_file
from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.mcap_log.log_copy import LogCopy
from shared.mcap_log.reader import LogReader, LostBytes, open_log

Stop: TypeAlias = Callable[[], bool]

_LINE_MAX: Final = 3  # damaged places that get a line each
_INDICES: Final = MappingProxyType(
    {
        Opcode.CHUNK: Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT: Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA: Opcode.METADATA_INDEX,
    }
)
"""Records that a summary says the place of."""


class Interrupted(Exception):  # noqa: N818 - not an error: the recorder is to stop
    """The recovery was interrupted; the original is unchanged."""


class RecoveryResult(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of a recovery: what it kept and what it lost."""

    out: Path
    finished: bool
    """The file was finished already."""
    messages: int
    attachments: int
    first_ns: int
    """Log time of the first and the last message kept; 0 without any."""
    last_ns: int
    orphans: int
    """Messages of undefined channels; left out."""
    passed_over: int
    """Records of kinds that the format does not define; left out."""
    counted: int | None
    """Messages that the original's summary counts; None if it has none or is damaged."""
    earlier_ends: int
    """Ends in the middle of the original; left out."""
    cut: LostBytes | None
    damage: tuple[LostBytes, ...]


def is_finished(path: Path) -> bool:
    """Return True if an MCAP file is finished; RunError if it cannot be read."""
    with open_log(path) as reader:
        return reader.finished


def is_whole(path: Path) -> bool:
    """Return True if a file is finished once, undamaged, and counts and indexes all it holds."""
    with open_log(path) as reader:
        if not reader.finished:
            return False
        found: Counter[int] = Counter()
        messages = 0
        for record in reader:
            if record.rows and record.opcode == Opcode.MESSAGE:
                return False
            found[record.opcode] += record.opcode != Opcode.CHUNK or bool(record.rows)
            messages += len(record.rows)
        return (
            not (reader.damage or reader.earlier_ends)
            and all(reader.in_summary[index] >= found[kind] for kind, index in _INDICES.items())
            and reader.message_count in (None, messages)
        )


def recover(path: Path, out: Path, stop: Stop = lambda: False) -> RecoveryResult:
    """Copy what can be read of a file into a finished one, which then replaces `out`.

    `stop` is called between chunks; True interrupts. Raises RunError if the file cannot be read or
    the copy cannot be written, and Interrupted.
    """
    with open_log(path) as reader:
        try:
            with atomic_file(out, lasting=True) as file:
                copy = LogCopy(file, reader.raw)
                for record in reader:
                    if stop():
                        raise Interrupted
                    copy.take(record)
                copy.finish(_note(path, copy, reader))
        except OSError as error:
            raise RunError(
                f"{out}: cannot be written: {error.strerror or error}; {path} is as it was; "
                "free space there, or recover elsewhere with -o"
            ) from None
    return RecoveryResult(
        out=out,
        finished=reader.finished,
        messages=copy.counts.message_count,
        attachments=copy.counts.attachment_count,
        first_ns=copy.counts.message_start_time,
        last_ns=copy.counts.message_end_time,
        orphans=copy.orphans,
        passed_over=reader.passed_over,
        counted=reader.message_count,
        earlier_ends=reader.earlier_ends,
        cut=reader.cut,
        damage=tuple(reader.damage),
    )


def describe(outcome: RecoveryResult) -> list[str]:
    """Return one line for what was kept and one for each loss."""
    kept = f"{outcome.messages} messages"
    if outcome.messages:
        seconds = (outcome.last_ns - outcome.first_ns) / NS_PER_S
        kept += f" over {seconds:.2f} s, the last at {clock_time(outcome.last_ns)}"
    lines = [f"kept: {kept}; {outcome.attachments} attachments"]
    uncounted = describe_count(outcome.counted, outcome.messages + outcome.orphans)
    if outcome.cut or outcome.damage or not uncounted:
        lines += describe_lost(outcome.cut, outcome.damage, finished=outcome.finished)
    lines += uncounted
    if outcome.earlier_ends:
        lines.append(f"left out: {describe_earlier_ends(outcome.earlier_ends)}")
    if outcome.orphans:
        lines.append(f"lost: {outcome.orphans} messages of undefined channels")
    if outcome.passed_over:
        lines.append(f"left out: {describe_passed_over(outcome.passed_over)}")
    return lines


def describe_passed_over(count: int) -> str:
    """Return words for records of unknown kinds."""
    return f"{count} private record{'s' * (count != 1)}, or of a later version of MCAP"


def describe_earlier_ends(count: int) -> str:
    """Return words for ends in the middle of a file."""
    return f"{count} end{'s' * (count != 1)} in the middle of the file, where some readers stop"


def describe_count(counted: int | None, found: int) -> list[str]:
    """Return a line if a file's summary does not count as many messages as were found in it."""
    if counted is None or counted == found:
        return []
    if found > counted:
        return [f"its summary counts only {counted} of its {found} messages"]
    return [f"lost: {counted - found} of the {counted} messages that its summary counts"]


def describe_lost(
    cut: LostBytes | None, damage: tuple[LostBytes, ...] | list[LostBytes], *, finished: bool
) -> list[str]:
    """Return a line for each place of a file that cannot be read."""
    lines = []
    if cut is not None:
        lines.append(f"lost: the last {cut.end - cut.start} bytes, cut off{_when(cut)}")
    lines += [_describe_damage(loss) for loss in damage[:_LINE_MAX]]
    if len(damage) > _LINE_MAX:
        more = damage[_LINE_MAX:]
        size = sum(loss.end - loss.start for loss in more)
        lines.append(f"lost: up to {size} damaged bytes at {len(more)} more places")
    if not lines:
        lines.append("lost: nothing" if finished else "lost: nothing that had reached the file")
    return lines


def _describe_damage(loss: LostBytes) -> str:
    if loss.missing is None:
        return f"lost: {loss.end - loss.start} damaged bytes from {loss.start} on{_when(loss)}"
    found = f"lost: part of the chunk at byte {loss.start}, whose writer did not complete a record"
    count = f"{loss.missing} message{'s' * (loss.missing != 1)}"
    return f"{found}; by its index, {count}{_when(loss)}" if loss.missing else found


def clock_time(time_ns: int) -> str:
    """Return a log time as local time of day, or as seconds if it is no date."""
    if time_ns < 10**17:  # lockstep: virtual time from 0
        return f"{time_ns / NS_PER_S:.3f} s"
    try:
        date = datetime.fromtimestamp(time_ns / NS_PER_S).astimezone()
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"
    return date.isoformat(sep=" ", timespec="milliseconds")


def _note(path: Path, copy: LogCopy, reader: LogReader) -> Metadata:
    losses = [*reader.damage, *([reader.cut] if reader.cut else [])]
    lost = sum(loss.end - loss.start for loss in losses if loss.missing is None)
    note = {"from": path.name, "messages": str(copy.counts.message_count), "lost_bytes": str(lost)}
    return Metadata(name="recovered", metadata=note)


def _when(loss: LostBytes) -> str:
    if not loss.last_ns >= loss.first_ns > 0:
        return ""
    seconds = (loss.last_ns - loss.first_ns) / NS_PER_S
    return f": {seconds:.3f} s up to {clock_time(loss.last_ns)}"
