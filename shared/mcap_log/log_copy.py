"""A copy of a log with the end that it lacks.

Chunks are copied as they are, byte for byte, and get the index that they lack. The mcap package's
writer cannot copy a chunk that exists already, and adding each message again cost 36 us a message.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import BinaryIO

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

from shared.mcap_log.reader import LOOSE_MAX, LogRecord
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


class LogCopy:
    """Takes the records of a file in their order and writes what a finished file needs.

    `raw` gives the original's bytes from one offset to another.
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
            head = MAGIC + encode(Header(profile=profile, library="xrl log recover"))
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
