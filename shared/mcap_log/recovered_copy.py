"""The copy of an unfinished file: its records as they were, and the end that it lacks."""

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

from shared.mcap_log.encoding import compressed_chunk, file_end, message_index
from shared.mcap_log.reader import LOOSE_MAX, LogRecord
from shared.mcap_log.records import (
    MAGIC,
    MESSAGE_RECORD,
    ChunkMessage,
    encode,
    split_chunk,
    with_prefix,
)


class LogCopy:
    """Takes the records of a file in their order and writes what a finished file needs."""

    def __init__(
        self, file: BinaryIO, raw: Callable[[int, int], bytes], library: str = "xrl recover"
    ) -> None:
        """Prepare.

        Args:
            file: to write to.
            raw: gives the original's bytes from one offset to another.
            library: name of the writer, for the header.
        """
        self.channels: dict[int, Channel] = {}
        self.attachments = 0
        self.orphans = 0
        self.first_ns = self.last_ns = 0
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
        self._per_channel: dict[int, int] = {}
        self._chunk_count = self._metadata_count = 0
        self._index: dict[int, list[bytes]] = {
            Opcode.CHUNK_INDEX: [],
            Opcode.ATTACHMENT_INDEX: [],
            Opcode.METADATA_INDEX: [],
        }
        self._begun = False

    @property
    def messages(self) -> int:
        """Messages in the copy."""
        return sum(self._per_channel.values())

    def take(self, record: LogRecord) -> None:
        """Copy one record."""
        match record.value:
            case Schema() | Channel():
                self.define(record)
            case Header(profile=profile):
                self._begin(profile)
            case Attachment() as attachment:
                self._write_attachment(attachment, record.body)
            case Metadata() as metadata:
                self.write_metadata(metadata)
            case Chunk() as chunk:
                self._begin("")
                self._write_loose()
                for definition in record.definitions:
                    self.define(definition, replace=True)
                self._take_chunk(chunk, record)
            case _:
                if record.opcode == Opcode.MESSAGE:
                    self._begin("")
                    self._take_loose(record)

    def define(self, record: LogRecord, *, replace: bool = False) -> None:
        """Learn a schema or a channel.

        Args:
            record: of the schema or the channel.
            replace: it comes from a chunk, whose CRC vouches for it.
        """
        found, raw = record.value, with_prefix(record.opcode, record.body)
        if isinstance(found, Schema):
            if replace or (Opcode.SCHEMA, found.id) not in self._definitions:
                self._definitions[Opcode.SCHEMA, found.id] = raw
        elif isinstance(found, Channel):
            if not replace and found.id in self.channels:
                return
            if found.schema_id and (Opcode.SCHEMA, found.schema_id) not in self._definitions:
                # its messages are kept: a reader would refuse a file that lacks a schema
                raw = encode(dataclasses.replace(found, schema_id=0))
                self._without_schema.add(found.id)
            else:
                self._without_schema.discard(found.id)
            self.channels[found.id] = found
            self._definitions[Opcode.CHANNEL, found.id] = raw

    def write_metadata(self, metadata: Metadata) -> None:
        """Write a metadata record."""
        self._begin("")
        offset, length = self._write(encode(metadata))
        index = MetadataIndex(offset=offset, length=length, name=metadata.name)
        self._index[Opcode.METADATA_INDEX].append(encode(index))
        self._metadata_count += 1

    def finish(self, note: Metadata) -> None:
        """Write the end: a note of what this copy is, and the index."""
        self._begin("")
        self._write_loose()
        self._write_definitions()
        self.write_metadata(note)
        schemas, channels = self._defined(Opcode.SCHEMA), self._defined(Opcode.CHANNEL)
        statistics = Statistics(
            message_count=self.messages,
            schema_count=len(schemas),
            channel_count=len(channels),
            attachment_count=self.attachments,
            metadata_count=self._metadata_count,
            chunk_count=self._chunk_count,
            message_start_time=self.first_ns,
            message_end_time=self.last_ns,
            channel_message_counts=self._per_channel,
        )
        groups: dict[int, bytes] = {
            Opcode.SCHEMA: b"".join(schemas),
            Opcode.CHANNEL: b"".join(channels),
            Opcode.STATISTICS: encode(statistics),
        } | {opcode: b"".join(records) for opcode, records in self._index.items()}
        self._write(file_end(self._position, groups))

    def _begin(self, profile: str) -> None:
        if not self._begun:
            self._begun = True
            self._write(MAGIC + encode(Header(profile=profile, library=self._library)))

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
        if record.whole and right and described:
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
        rows, _ = split_chunk(content)
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
        offsets, before = {}, self._position
        for number, entries in by_channel.items():
            offsets[number] = self._position
            self._write(message_index(number, entries))
            self._per_channel[number] = self._per_channel.get(number, 0) + len(entries)
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
        self._index[Opcode.CHUNK_INDEX].append(encode(index))
        first_ns = chunk.message_start_time
        self.first_ns = min(self.first_ns, first_ns) if self._chunk_count else first_ns
        self.last_ns = max(self.last_ns, chunk.message_end_time)
        self._chunk_count += 1

    def _write_attachment(self, attachment: Attachment, body: bytes) -> None:
        self._begin("")
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
        self._index[Opcode.ATTACHMENT_INDEX].append(encode(index))
        self.attachments += 1

    def _write(self, data: bytes) -> tuple[int, int]:
        """Write; return offset and length."""
        self._file.write(data)
        self._position += len(data)
        return self._position - len(data), len(data)


def _cut_out(record: LogRecord, rows: list[ChunkMessage]) -> list[bytes]:
    """Return the records of some of the messages."""
    begin = MESSAGE_RECORD.size
    return [record.body[row.start - begin : row.end] for row in rows]
