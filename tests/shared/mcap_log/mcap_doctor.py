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
from pathlib import Path
from typing import Any, Final

import zstandard
from mcap import records
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

MAGIC_SIZE: Final = 8
PREFIX_SIZE: Final = 9
"""Bytes before a record: opcode and length."""
PROFILES: Final = ("", "ros1", "ros2")
SAME: Final = ("message_start_time", "message_end_time", "compression", "uncompressed_size")
"""Fields of a chunk that its index repeats."""

Key = tuple[type, int]


class Examined:
    """What the doctor says of a file."""

    def __init__(self, path: Path) -> None:
        self.errors: list[str] = []
        self.warnings: Counter[str] = Counter()
        self.messages = 0
        self._data = path.read_bytes()
        self._seen: dict[Key, Schema | Channel] = {}
        self._in_summary: set[Key] = set()
        self._kinds: list[str] = []
        self._chunks: dict[int, tuple[Chunk, int, set[int]]] = {}
        """By place: the chunk, its record's length, the channels in it."""
        self._indexes: dict[int, ChunkIndex] = {}
        self._statistics: list[Statistics] = []
        self._times: list[int] = []
        self._newest = 0
        try:
            for place, length, record in self._records():
                self._kinds.append(type(record).__name__)
                self._look(place, length, record)
        except (McapError, CRCValidationError, ValueError, struct.error) as error:
            self._require(False, f"cannot be read after a {self._kinds[-1:]}: {error!r}")
        for name in ("DataEnd", "Footer"):
            self._require(name in self._kinds, f"no {name}; the last record is {self._kinds[-1:]}")
        self._look_at_indexes()
        self._look_at_statistics()

    def _require(self, right: object, otherwise: str) -> None:
        if not right:
            self.errors.append(otherwise)

    def _records(self) -> Iterator[tuple[int, int, Any]]:
        """Yield (place, length with the prefix, record) of each record outside of chunks."""
        stream, place = io.BytesIO(self._data), MAGIC_SIZE
        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
            yield place, stream.tell() - place, record
            place = stream.tell()

    def _look(self, place: int, length: int, record: Any) -> None:
        match record:
            case records.Header(profile=profile):
                self._require(record.library, "no library in the header")
                if profile not in PROFILES:
                    self.warnings[f"profile {profile!r} is not a well-known one"] += 1
            case Schema() | Channel():
                self._look_at_definition(record)
            case Chunk():
                self._look_at_chunk(place, length, record)
            case Message():
                self._require(False, "a message outside of chunks: readers by index miss it")
            case ChunkIndex(chunk_start_offset=at):
                self._require(at not in self._indexes, f"two indexes of the chunk at {at}")
                self._indexes[at] = record
            case Statistics():
                self._statistics.append(record)
            case records.SummaryOffset():
                self._look_at_offset(record)

    def _look_at_definition(self, record: Schema | Channel) -> None:
        name = f"{type(record).__name__} {record.id}"
        key = (type(record), record.id)
        before = self._seen.get(key)
        if isinstance(record, Schema):
            self._require(record.id, "schema 0 is reserved")
            self._require(record.encoding, f"{name} has no encoding")
        elif record.schema_id:
            self._require((Schema, record.schema_id) in self._seen, f"{name} has an unknown schema")
        self._require(before in (None, record), f"{name} is described in two ways")
        if "DataEnd" in self._kinds:
            self._require(before, f"{name} is in the summary alone")
            self._in_summary.add(key)
            return
        if before is not None:
            self.warnings[f"{type(record).__name__} described twice"] += 1
        self._seen[key] = record

    def _look_at_chunk(self, place: int, length: int, chunk: Chunk) -> None:
        try:
            content = zstandard.decompress(chunk.data, chunk.uncompressed_size)
        except zstandard.ZstdError as error:
            self._require(False, f"chunk at {place}: {chunk.compression} {error}")
            return
        found = (len(content), zlib.crc32(content))
        right = (chunk.uncompressed_size, chunk.uncompressed_crc)
        self._require(found == right, f"chunk at {place}: size or CRC of its content")
        times, channels = [], set()
        for record in breakup_chunk(chunk):
            if isinstance(record, Schema | Channel):
                self._look_at_definition(record)
            elif isinstance(record, Message):
                known = (Channel, record.channel_id) in self._seen
                self._require(known, f"a message of channel {record.channel_id} before it")
                if record.log_time < self._newest:
                    self.warnings["a message's log time is before an earlier one's"] += 1
                self._newest = max(self._newest, record.log_time)
                channels.add(record.channel_id)
                times.append(record.log_time)
        indexed = (chunk.message_start_time, chunk.message_end_time)
        if times:
            span = (min(times), max(times))
            self._require(indexed == span, f"chunk at {place}: not from {indexed}")
            self._times += span
        self.messages += len(times)
        self._chunks[place] = chunk, length, channels

    def _look_at_offset(self, offset: records.SummaryOffset) -> None:
        name = f"summary offset of {offset.group_opcode}"
        place, end = offset.group_start, offset.group_start + offset.group_length
        while place < end:
            if self._data[place] != offset.group_opcode:
                self._require(False, f"{name}: another record at {place}")
                return
            size = int.from_bytes(self._data[place + 1 : place + PREFIX_SIZE], "little")
            place += PREFIX_SIZE + size
        self._require(place == end, f"{name}: ends within a record")

    def _look_at_indexes(self) -> None:
        for place, index in self._indexes.items():
            self._require(place in self._chunks, f"chunk index: no chunk at {place}")
            if place not in self._chunks:
                continue
            chunk, length, channels = self._chunks[place]
            lengths = (index.chunk_length, index.compressed_size)
            self._require((length, len(chunk.data)) == lengths, f"another length at {place}")
            for name in SAME:
                same = getattr(chunk, name) == getattr(index, name)
                self._require(same, f"chunk index: another {name} of the chunk at {place}")
            for number in channels:
                channel = self._seen.get((Channel, number))
                keys: set[Key] = {(Channel, number)}
                if isinstance(channel, Channel) and channel.schema_id:
                    keys.add((Schema, channel.schema_id))
                described = keys <= self._in_summary
                self._require(described, f"channel {number} or its schema is not in the summary")
        lacks = self._indexes and self._chunks.keys() - self._indexes.keys()
        self._require(not lacks, "a chunk has no index")

    def _look_at_statistics(self) -> None:
        self._require(len(self._statistics) < 2, "two statistics")
        for found in self._statistics:
            right = found.message_count == self.messages
            self._require(right, f"statistics: {found.message_count} messages")
            if self._times:
                span = (found.message_start_time, found.message_end_time)
                right = span == (min(self._times), max(self._times))
                self._require(right, "statistics: first or last log time")
