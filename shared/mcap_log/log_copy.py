"""Copies of a log: recovered with the end that it lacks, or with further messages in it.

Chunks are copied as they are, byte for byte, and get the index that they lack. The mcap package's
writer cannot copy a chunk that exists already, and adding each message again cost 36 us a message.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from shared.atomic_file import atomic_file
from shared.exceptions import RunError
from shared.mcap_log.reader import LOOSE_MAX, LogReader, LogRecord, open_log
from shared.mcap_log.records import (
    MAGIC,
    MESSAGE_RECORD,
    PREFIX,
    ChunkMessage,
    compressed_chunk,
    encode,
    file_end,
    message_index,
    split_chunk,
    with_prefix,
)


class LogCopy:
    """Takes the records of a file in their order and writes what a finished file needs.

    `raw` gives the original's bytes from one offset to another; `library` names the writer.
    """

    def __init__(
        self, file: BinaryIO, raw: Callable[[int, int], bytes], library: str = "xrl log recover"
    ) -> None:
        self.channels: dict[int, Channel] = {}
        self.orphans = 0
        """Messages of undefined channels; left out."""
        self.counts = Statistics(
            attachment_count=0, channel_count=0, channel_message_counts={}, chunk_count=0,
            message_count=0, message_end_time=0, message_start_time=0, metadata_count=0,
            schema_count=0,
        )  # fmt: skip
        self._file, self._raw, self._library = file, raw, library
        self._position = 0
        self._definitions: dict[tuple[int, int], bytes] = {}
        """By opcode and id: a schema's or a channel's record."""
        self._written: set[tuple[int, int]] = set()
        """Those that are in the copy already."""
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
        """Write the end: a note of what this copy is, and the index."""
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
        """Learn a schema or a channel; one that a chunk's CRC vouches for replaces another."""
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
            head = MAGIC + encode(Header(profile=profile, library=self._library))
            self._position += self._file.write(head)

    def _write(self, data: bytes) -> tuple[int, int]:
        """Write behind the header; return offset and length."""
        self._begin("")
        start = self._position
        self._file.write(data)
        self._position += len(data)
        return start, len(data)


def _cut_out(record: LogRecord, rows: list[ChunkMessage]) -> list[bytes]:
    """Return the records of some of the messages."""
    begin = MESSAGE_RECORD.size
    return [record.body[row.start - begin : row.end] for row in rows]


# ---- further messages

NOTE: Final = "export"
"""Metadata of an extended copy: where it comes from."""

_FIRST_ID: Final = 60_000  # of new schemas and channels: far beyond those of a recorder


class NewChannel(NamedTuple):
    """A channel to add; its encodings are named as in MCAP's registry."""

    topic: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    encoding: str
    """Encoding of the messages."""
    about: dict[str, str]


class NewMessage(NamedTuple):
    """A message to add."""

    channel: int
    """Index in the list of channels."""
    log_ns: int
    """Log time: ns since 1970, as in the recorded messages."""
    payload: bytes


def write_extended(
    path: Path, out: Path, channels: list[NewChannel], messages: Iterable[NewMessage]
) -> int:
    """Write a finished copy of a log with messages added; return the number of all in the copy.

    The log stays as it is; a file named `out` is replaced when the copy is complete. The topics of
    the channels are new, the messages come in the order of time. Raises RunError if the log cannot
    be read or has such a topic, or the copy cannot be written.
    """
    try:
        with open_log(path) as reader, atomic_file(out, lasting=True) as file:
            copy = LogCopy(file, reader.raw, "xrl log export")
            for record in _extended(path, reader, channels, messages):
                copy.take(record)
            copy.finish(Metadata(name=NOTE, metadata={"from": path.name}))
    except OSError as error:
        raise RunError(
            f"{out}: cannot be written: {error.strerror or error}; give another -o"
        ) from None
    return copy.counts.message_count


def _extended(
    path: Path, reader: LogReader, channels: list[NewChannel], messages: Iterable[NewMessage]
) -> Iterator[LogRecord]:
    """Yield a log's records and the new ones.

    New messages stand in chunks of their own between the recorded ones, so that a viewer finds what
    belongs together close by.
    """
    topics, sent = {channel.topic for channel in channels}, [0] * len(channels)
    waiting = iter(messages)
    following = next(waiting, None)

    def new_until(last_ns: float) -> Iterator[LogRecord]:
        nonlocal following
        while following is not None and following.log_ns <= last_ns:
            yield _message_as_read(following, sent[following.channel])
            sent[following.channel] += 1
            following = next(waiting, None)

    defined = False
    for record in reader:
        if record.rows and not defined:
            defined = True
            yield from _definitions_as_read(channels)
        for value in record.values():
            if isinstance(value, Channel) and value.topic in topics:
                raise RunError(f"{path}: has {value.topic} already; export the original")
        yield record
        if record.rows:
            yield from new_until(max(row.log_ns for row in record.rows))
    if not defined:
        yield from _definitions_as_read(channels)
    yield from new_until(math.inf)


def _definitions_as_read(channels: list[NewChannel]) -> Iterator[LogRecord]:
    for number, row in enumerate(channels, _FIRST_ID):
        schema = Schema(
            id=number, data=row.schema, encoding=row.schema_encoding, name=row.schema_name
        )
        channel = Channel(
            id=number, topic=row.topic, message_encoding=row.encoding, metadata=row.about,
            schema_id=number,
        )  # fmt: skip
        definitions: tuple[tuple[int, McapRecord], ...] = (
            (Opcode.SCHEMA, schema), (Opcode.CHANNEL, channel),
        )  # fmt: skip
        for opcode, value in definitions:
            yield LogRecord(opcode, 0, 0, encode(value)[PREFIX.size :], value)


def _message_as_read(message: NewMessage, seq: int) -> LogRecord:
    start = MESSAGE_RECORD.size
    head = (_FIRST_ID + message.channel, seq, message.log_ns, message.log_ns)
    length = start - PREFIX.size + len(message.payload)
    body = MESSAGE_RECORD.pack(Opcode.MESSAGE, length, *head) + message.payload
    row = ChunkMessage(*head, start, len(body))
    return LogRecord(Opcode.MESSAGE, 0, 0, body, rows=(row,))
