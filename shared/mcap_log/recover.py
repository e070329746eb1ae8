"""Recover an unfinished file: write a copy with the index that most readers need.

The original stays until the copy is complete and on the disk. A recovery that is killed leaves the
original unchanged, and the next one starts from the beginning.

Intact chunks are copied byte for byte, and the missing index is added. The mcap package's writer
cannot copy an existing chunk, and adding each message again took 36 us per message.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, Final, TypeAlias

import msgspec
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from shared.atomic_file import atomic_file
from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.mcap_log.reader import LOOSE_MAX, LogReader, LogRecord, LostBytes, open_log
from shared.mcap_log.records import (
    MAGIC,
    MESSAGE_RECORD,
    ChunkMessage,
    compressed_chunk,
    encode,
    file_end,
    message_index,
    split_chunk,
    with_prefix,
)

Stop: TypeAlias = Callable[[], bool]

_LINE_MAX: Final = 3  # damaged places that get a line each
_INDICES: Final = MappingProxyType(
    {
        Opcode.CHUNK: Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT: Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA: Opcode.METADATA_INDEX,
    }
)
"""Kinds of records whose offsets are in a summary, and the kinds of their index records."""


class Interrupted(Exception):  # noqa: N818 - not an error: the recorder must stop
    """The recovery was interrupted; the original is unchanged."""


class _RecoveryResult(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of a recovery: the kept and the lost data."""

    out: Path
    finished: bool
    """True if the file was already finished."""
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
    """Messages that the original's summary counts; None if that is missing or damaged."""
    earlier_ends: int
    """Number of file ends found in the middle of the original; left out."""
    cut: LostBytes | None
    damage: tuple[LostBytes, ...]


def is_finished(path: Path) -> bool:
    """Return True if an MCAP file is finished; raise RunError if it cannot be read."""
    with open_log(path) as reader:
        return reader.finished


def is_whole(path: Path) -> bool:
    """Return True if a file is undamaged, ends only once, and counts and indexes all content."""
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


def recover(path: Path, out: Path, stop: Stop = lambda: False) -> _RecoveryResult:
    """Copy the readable part of a file into a finished one, which then replaces `out`.

    `stop` is called before each record; if it returns True, Interrupted is raised. Raises RunError
    if the file cannot be read or the copy cannot be written.
    """
    with open_log(path) as reader:
        try:
            with atomic_file(out, lasting=True) as file:
                copy = _LogCopy(file, reader.raw)
                for record in reader:
                    if stop():
                        raise Interrupted
                    copy.take(record)
                copy.finish(_note(path, copy, reader))
        except OSError as error:
            raise RunError(
                f"{out}: cannot be written: {error.strerror or error}; {path} is unchanged; "
                "free some space, or choose another output with -o"
            ) from None
    return _RecoveryResult(
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


def describe(outcome: _RecoveryResult) -> list[str]:
    """Return a line for the data that was kept, then lines for the data lost or left out."""
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
    """Describe records of kinds that the format does not define."""
    return f"{count} record{'s' * (count != 1)}, private or from a later version of MCAP"


def describe_earlier_ends(count: int) -> str:
    """Describe ends of a file that have more data after them."""
    return f"{count} end{'s' * (count != 1)} in the middle of the file, where some readers stop"


def describe_count(counted: int | None, found: int) -> list[str]:
    """Return a line if a file has more or fewer messages than its summary counts."""
    if counted is None or counted == found:
        return []
    if found > counted:
        return [f"the file's summary counts only {counted} of {found} messages"]
    return [f"lost: {counted - found} of the {counted} messages that its summary counts"]


def describe_lost(
    cut: LostBytes | None, damage: tuple[LostBytes, ...] | list[LostBytes], *, finished: bool
) -> list[str]:
    """Return a line for each unreadable part of a file, or one line if nothing was lost."""
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
    """Return a log time as local date and time, or in s or ns if it is not a date."""
    if time_ns < 10**17:  # lockstep: virtual time from 0
        return f"{time_ns / NS_PER_S:.3f} s"
    try:
        date = datetime.fromtimestamp(time_ns / NS_PER_S).astimezone()
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"
    return date.isoformat(sep=" ", timespec="milliseconds")


def _note(path: Path, copy: _LogCopy, reader: LogReader) -> Metadata:
    losses = [*reader.damage, *([reader.cut] if reader.cut else [])]
    lost = sum(loss.end - loss.start for loss in losses if loss.missing is None)
    note = {"from": path.name, "messages": str(copy.counts.message_count), "lost_bytes": str(lost)}
    return Metadata(name="recovered", metadata=note)


def _when(loss: LostBytes) -> str:
    if not loss.last_ns >= loss.first_ns > 0:
        return ""
    seconds = (loss.last_ns - loss.first_ns) / NS_PER_S
    return f": {seconds:.3f} s up to {clock_time(loss.last_ns)}"


class _LogCopy:
    """Finished copy of a file, written from its records in order.

    `raw` returns the original's bytes from one offset to another.
    """

    def __init__(self, file: BinaryIO, raw: Callable[[int, int], bytes]) -> None:
        self.channels: dict[int, Channel] = {}
        self.orphans = 0
        """Messages of undefined channels; left out."""
        self.counts = Statistics(
            attachment_count=0, channel_count=0, channel_message_counts={}, chunk_count=0,
            message_count=0, message_end_time=0, message_start_time=0, metadata_count=0,
            schema_count=0,
        )  # fmt: skip
        self._file, self._raw = file, raw
        self._position = 0
        self._definitions: dict[tuple[int, int], bytes] = {}
        """By opcode and id: a schema's or a channel's record."""
        self._written: set[tuple[int, int]] = set()
        """Definitions that are in the copy already."""
        self._without_schema: set[int] = set()
        """Channels whose schema is lost."""
        self._loose: list[bytes] = []
        self._loose_size = 0
        opcodes = (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
        self._index: dict[int, bytearray] = {opcode: bytearray() for opcode in opcodes}

    def take(self, record: LogRecord) -> None:
        """Copy one record."""
        match record.value:
            case Schema() | Channel():
                self._define(record)
            case Header(profile=profile):
                self._begin(profile)
            case Attachment() as attachment:
                self._write_attachment(attachment, record.body)
            case Metadata() as metadata:
                self._write_metadata(metadata)
            case Chunk() as chunk:
                self._write_loose()
                for definition in record.definitions:
                    self._define(definition, vouched=True)
                self._take_chunk(chunk, record)
            case _ if record.opcode == Opcode.MESSAGE:
                self._take_loose(record)

    def finish(self, note: Metadata) -> None:
        """Write the end: a note about this copy, and the index."""
        self._write_loose()
        self._write_definitions()
        self._write_metadata(note)
        schemas, channels = self._defined(Opcode.SCHEMA), self._defined(Opcode.CHANNEL)
        self.counts.schema_count, self.counts.channel_count = len(schemas), len(channels)
        groups: dict[int, bytes] = {
            Opcode.SCHEMA: b"".join(schemas),
            Opcode.CHANNEL: b"".join(channels),
            Opcode.STATISTICS: encode(self.counts),
        } | {opcode: bytes(records) for opcode, records in self._index.items()}
        self._write(file_end(self._position, groups))

    def _define(self, record: LogRecord, *, vouched: bool = False) -> None:
        """Store a schema or a channel; one that a chunk's CRC covers replaces another."""
        found, raw = record.value, with_prefix(record.opcode, record.body)
        if isinstance(found, Schema):
            if vouched or (Opcode.SCHEMA, found.id) not in self._definitions:
                self._definitions[Opcode.SCHEMA, found.id] = raw
        elif isinstance(found, Channel):
            if not vouched and found.id in self.channels:
                return
            if found.schema_id and (Opcode.SCHEMA, found.schema_id) not in self._definitions:
                # its messages are kept: a reader would refuse a file that lacks a schema
                raw = encode(dataclasses.replace(found, schema_id=0))
                self._without_schema.add(found.id)
            else:
                self._without_schema.discard(found.id)
            self.channels[found.id] = found
            self._definitions[Opcode.CHANNEL, found.id] = raw

    def _defined(self, opcode: int) -> list[bytes]:
        return [record for (of, _), record in self._definitions.items() if of == opcode]

    def _write_definitions(self) -> None:
        """Write schemas, then channels that are not in the copy yet, before their messages."""
        for key in sorted(self._definitions.keys() - self._written):
            self._written.add(key)
            self._write(self._definitions[key])

    def _take_chunk(self, chunk: Chunk, record: LogRecord) -> None:
        rows = self._described(record)
        if not rows:
            return
        times = [row.log_ns for row in rows]
        right = (chunk.message_start_time, chunk.message_end_time) == (min(times), max(times))
        described = len(rows) == len(record.rows) and not self._without_schema
        if record.lost is None and right and described:
            self._write_chunk(chunk, self._raw(record.start, record.end), rows)
        else:
            self._write_rows(_cut_out(record, rows))

    def _take_loose(self, record: LogRecord) -> None:
        self._loose += _cut_out(record, self._described(record))
        self._loose_size += len(record.body)
        if self._loose_size > LOOSE_MAX:
            self._write_loose()

    def _described(self, record: LogRecord) -> list[ChunkMessage]:
        """Return the messages of known channels; the others are counted."""
        rows = [row for row in record.rows if row.channel_id in self.channels]
        self.orphans += len(record.rows) - len(rows)
        return rows

    def _write_loose(self) -> None:
        if self._loose:
            self._write_rows(self._loose)
        self._loose, self._loose_size = [], 0

    def _write_rows(self, records: list[bytes]) -> None:
        """Write message records as a chunk of their own."""
        content = b"".join(records)
        rows = split_chunk(content).rows
        times = [row.log_ns for row in rows]
        chunk = compressed_chunk(min(times), max(times), content)
        self._write_chunk(chunk, encode(chunk), rows)

    def _write_chunk(self, chunk: Chunk, raw: bytes, rows: list[ChunkMessage]) -> None:
        self._write_definitions()
        start, length = self._write(raw)
        by_channel: dict[int, list[tuple[int, int]]] = {}
        for row in rows:
            at = row.start - MESSAGE_RECORD.size
            by_channel.setdefault(row.channel_id, []).append((row.log_ns, at))
        offsets, before, counts = {}, self._position, self.counts
        for number, entries in by_channel.items():
            offsets[number] = self._position
            self._write(message_index(number, entries))
            so_far = counts.channel_message_counts.get(number, 0)
            counts.channel_message_counts[number] = so_far + len(entries)
        index = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=start,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=self._position - before,
            message_index_offsets=offsets,
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
        self._index[Opcode.CHUNK_INDEX] += encode(index)
        first_ns = chunk.message_start_time
        counts.message_start_time = (
            min(counts.message_start_time, first_ns) if counts.chunk_count else first_ns
        )
        counts.message_end_time = max(counts.message_end_time, chunk.message_end_time)
        counts.message_count += len(rows)
        counts.chunk_count += 1

    def _write_metadata(self, metadata: Metadata) -> None:
        offset, length = self._write(encode(metadata))
        index = MetadataIndex(offset=offset, length=length, name=metadata.name)
        self._index[Opcode.METADATA_INDEX] += encode(index)
        self.counts.metadata_count += 1

    def _write_attachment(self, attachment: Attachment, body: bytes) -> None:
        offset, length = self._write(with_prefix(Opcode.ATTACHMENT, body))
        index = AttachmentIndex(
            offset=offset,
            length=length,
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )
        self._index[Opcode.ATTACHMENT_INDEX] += encode(index)
        self.counts.attachment_count += 1

    def _begin(self, profile: str) -> None:
        if not self._position:
            head = MAGIC + encode(Header(profile=profile, library="xrl log recover"))
            self._position += self._file.write(head)

    def _write(self, data: bytes) -> tuple[int, int]:
        """Write after the header; return offset and length."""
        self._begin("")
        start = self._position
        self._file.write(data)
        self._position += len(data)
        return start, len(data)


def _cut_out(record: LogRecord, rows: list[ChunkMessage]) -> list[bytes]:
    """Return the records of some of the messages."""
    begin = MESSAGE_RECORD.size
    return [record.body[row.start - begin : row.end] for row in rows]
