"""The copy of an unfinished file: its records as they were, and the end that it lacks."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import BinaryIO, Final

from services.recorder import mcap_encoding as encoding
from services.recorder import mcap_records as mcap
from services.recorder.mcap_encoding import Totals
from services.recorder.mcap_records import MESSAGE_RECORD, Chunk, ChunkMessage, Malformed
from services.recorder.reader import Piece

LIBRARY: Final = "xrl recover"

_LOOSE_MAX: Final = 1 << 20
"""Messages outside of chunks are put into chunks of this size."""


class Copy:
    """Takes the pieces of a file in their order and writes what a finished file needs."""

    def __init__(self, file: BinaryIO, raw: Callable[[int, int], bytes]) -> None:
        """Write to a file; `raw` gives the original's bytes from one place to another."""
        self.channels: dict[int, mcap.Channel] = {}
        self.attachments = 0
        self.orphans = 0
        self.first_ns = self.last_ns = 0
        self._file, self._raw = file, raw
        self._position = 0
        self._schemas: dict[int, bytes] = {}
        self._channel_bodies: dict[int, bytes] = {}
        self._announced: set[tuple[int, int]] = set()
        """(opcode, id) of the schemas and channels that are in the copy already."""
        self._schemaless: set[int] = set()
        """Channels whose schema is lost."""
        self._loose: list[bytes] = []
        self._loose_size = 0
        self._per_channel: dict[int, int] = {}
        self._chunks = self._metadata = 0
        self._index: dict[int, list[bytes]] = {
            mcap.CHUNK_INDEX: [],
            mcap.ATTACHMENT_INDEX: [],
            mcap.METADATA_INDEX: [],
        }
        self._begun = False

    @property
    def messages(self) -> int:
        """Messages in the copy."""
        return sum(self._per_channel.values())

    def take(self, piece: Piece) -> None:
        """Take over one piece."""
        if piece.opcode in (mcap.SCHEMA, mcap.CHANNEL):
            self._define(piece.opcode, piece.body)
            return
        if piece.opcode == mcap.HEADER:
            if not self._begun:
                self._begin(mcap.header(piece.body)[0])
            return
        self._begin("")
        if piece.opcode == mcap.CHUNK:
            self._write_loose()
            for opcode, body in piece.others:
                with contextlib.suppress(Malformed):
                    self._define(opcode, body, anew=True)
            self._take_chunk(piece)
        elif piece.opcode == mcap.MESSAGE:
            self._take_loose(piece)
        elif piece.opcode == mcap.METADATA:
            self._write_metadata(piece.body)
        elif piece.opcode == mcap.ATTACHMENT:
            found = mcap.attachment(piece.body)
            place = self._write(encoding.record(mcap.ATTACHMENT, piece.body))
            index = encoding.attachment_index_record(place, found)
            self._index[mcap.ATTACHMENT_INDEX].append(index)
            self.attachments += 1

    def finish(self, source: str, lost_bytes: int) -> None:
        """Write the end: a note of the recovery, and the index.

        Args:
            source: name of the original.
            lost_bytes: of it that could not be read.
        """
        self._begin("")
        self._write_loose()
        self._announce()
        note = {"from": source, "messages": str(self.messages), "lost_bytes": str(lost_bytes)}
        self._write_metadata(encoding.metadata_body("recovered", note))
        totals = Totals(
            self.messages,
            len(self._schemas),
            len(self._channel_bodies),
            self.attachments,
            self._metadata,
            self._chunks,
            self.first_ns,
            self.last_ns,
        )
        groups = {
            mcap.SCHEMA: _joined(mcap.SCHEMA, self._schemas),
            mcap.CHANNEL: _joined(mcap.CHANNEL, self._channel_bodies),
            mcap.STATISTICS: encoding.statistics_record(totals, self._per_channel),
        } | {opcode: b"".join(records) for opcode, records in self._index.items()}
        self._write(encoding.ending(self._position, groups))

    def _begin(self, profile: str) -> None:
        if not self._begun:
            self._begun = True
            self._write(mcap.MAGIC + encoding.header_record(profile, LIBRARY))

    def _define(self, opcode: int, body: bytes, *, anew: bool = False) -> None:
        """Learn of a schema or a channel; `anew`: from a chunk, whose CRC vouches for it."""
        if opcode == mcap.SCHEMA:
            number = mcap.schema(body).id
            if anew or number not in self._schemas:
                self._schemas[number] = body
        elif opcode == mcap.CHANNEL:
            channel = mcap.channel(body)
            if not anew and channel.id in self.channels:
                return
            if channel.schema_id and channel.schema_id not in self._schemas:
                # its messages are kept: a reader would refuse a file that lacks a schema
                body = encoding.without_schema(body)
                self._schemaless.add(channel.id)
            else:
                self._schemaless.discard(channel.id)
            self.channels[channel.id] = channel
            self._channel_bodies[channel.id] = body

    def _announce(self) -> None:
        """Write schemas and channels that are not in the copy yet, before their messages."""
        for opcode, bodies in (
            (mcap.SCHEMA, self._schemas), (mcap.CHANNEL, self._channel_bodies),
        ):  # fmt: skip
            for number, body in bodies.items():
                if (opcode, number) not in self._announced:
                    self._announced.add((opcode, number))
                    self._write(encoding.record(opcode, body))

    def _take_chunk(self, piece: Piece) -> None:
        if piece.chunk is None:
            return
        rows = [row for row in piece.rows if row.channel_id in self.channels]
        self.orphans += len(piece.rows) - len(rows)
        if not rows:
            return
        times = [row.log_ns for row in rows]
        right = (piece.chunk.first_ns, piece.chunk.last_ns) == (min(times), max(times))
        described = len(rows) == len(piece.rows) and not self._schemaless
        if piece.whole and right and described:
            self._write_chunk(piece.chunk, self._raw(piece.start, piece.end), rows)
        else:
            begin = MESSAGE_RECORD.size
            self._write_rows([piece.body[row.start - begin : row.end] for row in rows])

    def _take_loose(self, piece: Piece) -> None:
        if any(row.channel_id not in self.channels for row in piece.rows):
            self.orphans += len(piece.rows)
            return
        self._loose.append(encoding.record(mcap.MESSAGE, piece.body))
        self._loose_size += len(piece.body)
        if self._loose_size > _LOOSE_MAX:
            self._write_loose()

    def _write_loose(self) -> None:
        if self._loose:
            self._write_rows(self._loose)
            self._loose, self._loose_size = [], 0

    def _write_rows(self, records: list[bytes]) -> None:
        """Write message records as a chunk of their own."""
        content = b"".join(records)
        rows, _ = mcap.contents(content)
        times = [row.log_ns for row in rows]
        raw = encoding.chunk_record(min(times), max(times), content)
        self._write_chunk(mcap.chunk(raw[mcap.PREFIX.size :]), raw, rows)

    def _write_chunk(self, chunk: Chunk, raw: bytes, rows: list[ChunkMessage]) -> None:
        self._announce()
        place = self._write(raw)
        by_channel: dict[int, list[tuple[int, int]]] = {}
        for row in rows:
            at = row.start - MESSAGE_RECORD.size
            by_channel.setdefault(row.channel_id, []).append((row.log_ns, at))
        offsets, before = {}, self._position
        for number, entries in by_channel.items():
            offsets[number] = self._position
            self._write(encoding.message_index_record(number, entries))
            self._per_channel[number] = self._per_channel.get(number, 0) + len(entries)
        index = encoding.chunk_index_record(chunk, place, offsets, self._position - before)
        self._index[mcap.CHUNK_INDEX].append(index)
        self.first_ns = min(self.first_ns, chunk.first_ns) if self._chunks else chunk.first_ns
        self.last_ns = max(self.last_ns, chunk.last_ns)
        self._chunks += 1

    def _write_metadata(self, body: bytes) -> None:
        name, _ = mcap.metadata(body)
        place = self._write(encoding.record(mcap.METADATA, body))
        self._index[mcap.METADATA_INDEX].append(encoding.metadata_index_record(place, name))
        self._metadata += 1

    def _write(self, data: bytes) -> tuple[int, int]:
        """Write, and return where and how much."""
        self._file.write(data)
        self._position += len(data)
        return self._position - len(data), len(data)


def _joined(opcode: int, bodies: dict[int, bytes]) -> bytes:
    return b"".join(encoding.record(opcode, body) for body in bodies.values())
