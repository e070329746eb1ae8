"""The questions of `mcap doctor`, asked with the mcap package's stream reader.

`mcap` is the format's own command-line tool, a Go and lately a Rust program: the tests cannot
install it. These are the questions of go/cli/mcap/cmd/doctor.go (repository foxglove/mcap,
686f869), and two more: whether the summary's offsets point at what they say, and whether every
chunk has its index.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import zstandard
from mcap import records
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

MAGIC_SIZE: Final = 8
PREFIX_SIZE: Final = 9
"""Of a record: opcode and length."""
PROFILES: Final = ("", "ros1", "ros2")
SAME: Final = ("message_start_time", "message_end_time", "compression", "uncompressed_size")
"""Fields of a chunk that its index repeats."""


@dataclass
class Examined:
    """What the doctor says."""

    errors: list[str] = field(default_factory=list)
    warnings: Counter[str] = field(default_factory=Counter)
    messages: int = 0


def examined(path: Path) -> Examined:
    """Examine a file."""
    doctor = _Doctor(path.read_bytes())
    doctor.examine()
    return doctor.found


class _Doctor:
    def __init__(self, data: bytes) -> None:
        self.found = Examined()
        self._data = data
        self._seen: dict[tuple[type, int], Schema | Channel] = {}
        self._in_summary: set[tuple[type, int]] = set()
        self._ended = self._footed = False
        self._chunks: dict[int, tuple[Chunk, int, set[int]]] = {}
        """By place: the chunk, its record's length, the channels in it."""
        self._indexes: dict[int, ChunkIndex] = {}
        self._statistics: list[Statistics] = []
        self._times: list[int] = []
        self._newest = 0

    def examine(self) -> None:
        last = "nothing"
        try:
            for place, length, record in self._records():
                last = type(record).__name__
                self._look(place, length, record)
        except (McapError, CRCValidationError, ValueError, struct.error) as error:
            self._error(f"cannot be read after a {last}: {error!r}")
        for name, there in (("DataEnd", self._ended), ("Footer", self._footed)):
            if not there:
                self._error(f"no {name}; the last record is a {last}")
        self._look_at_indexes()
        self._look_at_statistics()

    def _records(self) -> Iterator[tuple[int, int, Any]]:
        """Yield (place, length with the prefix, record) of each record outside of chunks."""
        stream = io.BytesIO(self._data)
        place = MAGIC_SIZE
        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
            yield place, stream.tell() - place, record
            place = stream.tell()

    def _length_at(self, place: int) -> int:
        return int.from_bytes(self._data[place + 1 : place + PREFIX_SIZE], "little")

    def _look(self, place: int, length: int, record: Any) -> None:
        match record:
            case records.Header():
                if not record.library:
                    self._warn("no library in the header")
                if record.profile not in PROFILES:
                    self._warn(f"profile {record.profile!r} is not a well-known one")
            case Schema() | Channel():
                self._look_at_definition(record)
            case Chunk():
                self._look_at_chunk(place, length, record)
            case Message():
                self._error("a message outside of chunks: readers by index miss it")
            case ChunkIndex():
                if record.chunk_start_offset in self._indexes:
                    self._error(f"two indexes of the chunk at {record.chunk_start_offset}")
                self._indexes[record.chunk_start_offset] = record
            case Statistics():
                self._statistics.append(record)
            case records.SummaryOffset():
                self._look_at_offset(record)
            case records.DataEnd():
                self._ended = True
            case records.Footer():
                self._footed = True

    def _look_at_definition(self, record: Schema | Channel) -> None:
        kind = type(record).__name__
        key = (type(record), record.id)
        before = self._seen.get(key)
        if isinstance(record, Schema):
            if record.id == 0:
                self._error("schema 0 is reserved")
            if not record.encoding:
                self._error(f"schema {record.id} has no encoding")
        elif record.schema_id and (Schema, record.schema_id) not in self._seen:
            self._error(f"channel {record.id} has unknown schema {record.schema_id}")
        if before is not None and before != record:
            self._error(f"{kind} {record.id} is described in two ways")
        if self._ended:
            if before is None:
                self._error(f"{kind} {record.id} is in the summary alone")
            self._in_summary.add(key)
            return
        if before is not None:
            self._warn(f"{kind} described twice")
        self._seen[key] = record

    def _look_at_chunk(self, place: int, length: int, chunk: Chunk) -> None:
        if chunk.compression != "zstd":
            self._error(f"chunk at {place}: compression {chunk.compression!r}")
            return
        try:
            content = zstandard.decompress(chunk.data, chunk.uncompressed_size)
        except zstandard.ZstdError as error:
            self._error(f"chunk at {place}: {error}")
            return
        if len(content) != chunk.uncompressed_size or zlib.crc32(content) != chunk.uncompressed_crc:
            self._error(f"chunk at {place}: size or CRC of its content")
        times, channels = [], set()
        for record in breakup_chunk(chunk):
            if isinstance(record, Schema | Channel):
                self._look_at_definition(record)
            if not isinstance(record, Message):
                continue
            channels.add(record.channel_id)
            if (Channel, record.channel_id) not in self._seen:
                self._error(f"a message of channel {record.channel_id} before the channel")
            if record.log_time < self._newest:
                self._warn("a message's log time is before an earlier one's")
            self._newest = max(self._newest, record.log_time)
            times.append(record.log_time)
        indexed = (chunk.message_start_time, chunk.message_end_time)
        if times and indexed != (min(times), max(times)):
            self._error(f"chunk at {place}: not from {indexed[0]} to {indexed[1]}")
        self.found.messages += len(times)
        self._times += times
        self._chunks[place] = chunk, length, channels

    def _look_at_offset(self, offset: records.SummaryOffset) -> None:
        place, end = offset.group_start, offset.group_start + offset.group_length
        while place < end:
            if self._data[place] != offset.group_opcode:
                self._error(f"summary offset of {offset.group_opcode}: another record at {place}")
                return
            place += PREFIX_SIZE + self._length_at(place)
        if place != end:
            self._error(f"summary offset of {offset.group_opcode}: ends within a record")

    def _look_at_indexes(self) -> None:
        for place, index in self._indexes.items():
            if place not in self._chunks:
                self._error(f"chunk index: no chunk at {place}")
                continue
            chunk, length, channels = self._chunks[place]
            if (length, len(chunk.data)) != (index.chunk_length, index.compressed_size):
                self._error(f"chunk index: another length of the chunk at {place}")
            for name in SAME:
                if getattr(chunk, name) != getattr(index, name):
                    self._error(f"chunk index: another {name} of the chunk at {place}")
            for number in channels:
                channel = self._seen.get((Channel, number))
                keys: set[tuple[type, int]] = {(Channel, number)}
                if isinstance(channel, Channel) and channel.schema_id:
                    keys.add((Schema, channel.schema_id))
                if not keys <= self._in_summary:
                    self._error(f"channel {number} or its schema is not in the summary")
        if self._indexes and self._chunks.keys() - self._indexes.keys():
            self._error("a chunk has no index")

    def _look_at_statistics(self) -> None:
        if len(self._statistics) > 1:
            self._error("two statistics")
        for found in self._statistics:
            if found.message_count != self.found.messages:
                self._error(f"statistics: {found.message_count} messages")
            if self._times and (found.message_start_time, found.message_end_time) != (
                min(self._times), max(self._times),
            ):  # fmt: skip
                self._error("statistics: first or last log time")

    def _error(self, text: str) -> None:
        self.found.errors.append(text)

    def _warn(self, text: str) -> None:
        self.found.warnings[text] += 1
