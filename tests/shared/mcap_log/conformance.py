"""MCAP files written by hand from the format's specification: each with some of its features.

Nothing of this project and nothing of the mcap package writes a byte here: a fault of theirs cannot
hide in the files.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

MAGIC: Final = b"\x89MCAP0\r\n"
FROM_LATER: Final = b"\x01\x02\x03 a field of a later version"
PRIVATE, RESERVED = 0x80, 0x3F
"""Opcodes of a private record, and of one that the format may define some day."""


class Feature(Enum):
    """What a file may have; the names are those of the format's own conformance files."""

    CHUNK = "ch"
    MESSAGE_INDEX = "mx"
    CHUNK_INDEX = "chx"
    ATTACHMENT_INDEX = "ax"
    METADATA_INDEX = "mdx"
    REPEATED_SCHEMAS = "rsh"
    REPEATED_CHANNELS = "rch"
    STATISTICS = "st"
    SUMMARY_OFFSET = "sum"
    PAD = "pad"
    """Bytes behind the last field of each record that a later version may extend."""
    UNKNOWN = "unk"
    """Records of unknown kinds between all others."""


Features = frozenset[Feature]


class Message(NamedTuple):
    channel: int
    seq: int
    log_ns: int
    publish_ns: int
    payload: bytes


class Schema(NamedTuple):
    number: int
    name: str


class Channel(NamedTuple):
    number: int
    schema: int
    topic: str


class Attachment(NamedTuple):
    name: str
    content: bytes


class Metadata(NamedTuple):
    name: str
    entries: Mapping[str, str]


Record = Message | Schema | Channel | Attachment | Metadata

_SCHEMA, _CHANNEL = Schema(1, "Example"), Channel(1, 1, "example")
_ATTACHMENT, _METADATA = Attachment("file", b"\x01\x02\x03"), Metadata("about", {"foo": "bar"})
_TIMES = (1, 3, 2, 4, 4, 6, 5, 8, 9, 10)
_TEN = [Message(1, seq, t_ns, t_ns, b"123") for seq, t_ns in enumerate(_TIMES)]

CONTENTS: Final[Mapping[str, Sequence[Record]]] = {
    "no_data": (),
    "one_message": (_SCHEMA, _CHANNEL, Message(1, 10, 2, 1, b"123")),
    "one_schemaless_message": (Channel(1, 0, "example"), Message(1, 10, 2, 1, b"123")),
    "ten_messages": (_SCHEMA, _CHANNEL, *_TEN),
    "one_attachment": (_ATTACHMENT,),
    "one_metadata": (_METADATA,),
    "all_mixed": (
        _METADATA, _SCHEMA, _CHANNEL, *_TEN[:4], _ATTACHMENT, Channel(7, 0, "other"),
        Message(7, 0, 5, 5, b""), *_TEN[4:], Message(7, 1, 11, 11, b"last"),
        Metadata("at the end", {}),
    ),
}  # fmt: skip


def combinations() -> Iterator[tuple[str, Features]]:
    """Yield the names of contents with each set of features that makes sense for them."""
    every = list(Feature)
    sets = [frozenset(c) for n in range(len(every) + 1) for c in itertools.combinations(every, n)]
    for name, records in CONTENTS.items():
        kinds = {type(record) for record in records}
        for features in sets:
            if _makes_sense(features, kinds):
                yield name, features


def _makes_sense(features: Features, kinds: set[type]) -> bool:
    needs = (
        (Feature.CHUNK, Message in kinds),
        (Feature.MESSAGE_INDEX, Feature.CHUNK in features),
        (Feature.CHUNK_INDEX, Feature.CHUNK in features),
        (Feature.CHUNK_INDEX, Feature.REPEATED_CHANNELS in features),
        (Feature.ATTACHMENT_INDEX, Attachment in kinds),
        (Feature.METADATA_INDEX, Metadata in kinds),
        (Feature.REPEATED_SCHEMAS, Schema in kinds),
        (Feature.REPEATED_CHANNELS, Channel in kinds),
        (Feature.SUMMARY_OFFSET, bool(features & _SUMMARY)),
    )
    return all(met for feature, met in needs if feature in features)


_SUMMARY: Final = frozenset(
    {
        Feature.CHUNK_INDEX, Feature.ATTACHMENT_INDEX, Feature.METADATA_INDEX,
        Feature.REPEATED_SCHEMAS, Feature.REPEATED_CHANNELS, Feature.STATISTICS,
    }
)  # fmt: skip


def file_of(
    records: Sequence[Record], features: Features, *, compression: str = "", per_chunk: int = 100
) -> bytes:
    """Return a finished file.

    Args:
        records: its contents, in their order.
        features: of the file.
        compression: of its chunks.
        per_chunk: schemas, channels and messages in a chunk.
    """
    return _File(features, compression, per_chunk).write(records)


class _File:
    def __init__(self, features: Features, compression: str, per_chunk: int) -> None:
        self._features, self._compression, self._per_chunk = features, compression, per_chunk
        self._data = bytearray(MAGIC)
        self._waiting: list[Record] = []
        self._index: dict[int, list[bytes]] = {0x08: [], 0x0A: [], 0x0D: []}
        self._chunks = 0

    def write(self, records: Sequence[Record]) -> bytes:
        self._add(self._record(0x01, _text("") + _text("by hand")))
        for record in records:
            self._take(record)
        self._write_chunk()
        self._add(_plain(0x0F, struct.pack("<I", zlib.crc32(self._data))))
        start = len(self._data)
        groups = self._summary(records)
        offsets = b""
        for opcode, group in groups:
            begin = len(self._data)
            self._data += group
            place = struct.pack("<BQQ", opcode, begin, len(group))
            offsets += self._record(0x0E, place)
        offset_start = len(self._data) if self._has(Feature.SUMMARY_OFFSET) else 0
        self._data += offsets if offset_start else b""
        summary_start = start if len(self._data) > start else 0
        head = struct.pack("<BQQQ", 0x02, 20, summary_start, offset_start)
        crc = zlib.crc32(self._data[start:] + head)
        self._data += head + struct.pack("<I", crc) + MAGIC
        return bytes(self._data)

    def _has(self, feature: Feature) -> bool:
        return feature in self._features

    def _record(self, opcode: int, fields: bytes) -> bytes:
        """Return a record that later versions may extend, with what this file has about it."""
        record = _plain(opcode, fields + FROM_LATER * self._has(Feature.PAD))
        return record + self._unknown()

    def _unknown(self) -> bytes:
        if not self._has(Feature.UNKNOWN):
            return b""
        return _plain(PRIVATE, b"private") + _plain(RESERVED, b"") + _plain(0xFF, bytes(50))

    def _add(self, record: bytes) -> tuple[int, int]:
        """Append; return the offset, and the length of the record itself."""
        start = len(self._data)
        self._data += record
        return start, 9 + int.from_bytes(record[1:9], "little")

    def _take(self, record: Record) -> None:
        match record:
            case Attachment(name, content):
                fields = struct.pack("<QQ", 2, 1) + _text(name) + _text("application/octet-stream")
                fields += struct.pack("<Q", len(content)) + content
                fields += struct.pack("<I", zlib.crc32(fields))
                place = self._add(self._record(0x09, fields))
                index = struct.pack("<QQQQQ", *place, 2, 1, len(content)) + _text(name)
                index += _text("application/octet-stream")
                self._index[0x0A].append(self._record(0x0A, index))
            case Metadata(name, entries):
                place = self._add(self._record(0x0C, _text(name) + _map(entries)))
                index = struct.pack("<QQ", *place) + _text(name)
                self._index[0x0D].append(self._record(0x0D, index))
            case _ if self._has(Feature.CHUNK):
                self._waiting.append(record)
                if len(self._waiting) == self._per_chunk:
                    self._write_chunk()
            case _:
                self._add(self._content(record))

    def _content(self, record: Record) -> bytes:
        """Return a record that may stand in a chunk or outside."""
        match record:
            case Schema(number, name):
                fields = struct.pack("<H", number) + _text(name) + _text("c") + _text("\4\5\6")
                return self._record(0x03, fields)
            case Channel(number, schema, topic):
                fields = struct.pack("<HH", number, schema) + _text(topic) + _text("a")
                return self._record(0x04, fields + _map({"foo": "bar"}))
            case Message(channel, seq, log_ns, publish_ns, payload):
                head = struct.pack("<HIQQ", channel, seq, log_ns, publish_ns)
                return _plain(0x05, head + payload) + self._unknown()
        raise TypeError(record)

    def _write_chunk(self) -> None:
        content = b""
        entries: dict[int, list[tuple[int, int]]] = {}
        times = [record.log_ns for record in self._waiting if isinstance(record, Message)]
        for record in self._waiting:
            if isinstance(record, Message):
                entries.setdefault(record.channel, []).append((record.log_ns, len(content)))
            content += self._content(record)
        if not self._waiting:
            return
        self._waiting, self._chunks = [], self._chunks + 1
        span = min(times, default=0), max(times, default=0)
        data = _compressed(self._compression, content)
        fields = struct.pack("<QQQI", *span, len(content), zlib.crc32(content))
        fields += _text(self._compression) + struct.pack("<Q", len(data)) + data
        pad = FROM_LATER * self._has(Feature.PAD)
        start, length = self._add(_plain(0x06, fields + pad))  # its indices follow immediately
        offsets, before = b"", len(self._data)
        for channel, rows in entries.items() if self._has(Feature.MESSAGE_INDEX) else ():
            offsets += struct.pack("<HQ", channel, len(self._data))
            packed = b"".join(struct.pack("<QQ", *row) for row in rows)
            head = struct.pack("<HI", channel, len(packed))
            self._add(_plain(0x07, head + packed + pad))
        index_length = len(self._data) - before
        self._data += self._unknown()
        index = struct.pack("<QQQQ", *span, start, length)
        index += struct.pack("<I", len(offsets)) + offsets + struct.pack("<Q", index_length)
        index += _text(self._compression) + struct.pack("<QQ", len(data), len(content))
        self._index[0x08].append(self._record(0x08, index))

    def _summary(self, records: Sequence[Record]) -> list[tuple[int, bytes]]:
        """Return opcode and records of each group."""
        wanted = (
            (0x03, Feature.REPEATED_SCHEMAS, self._repeated(records, Schema)),
            (0x04, Feature.REPEATED_CHANNELS, self._repeated(records, Channel)),
            (0x0B, Feature.STATISTICS, self._statistics(records)),
            (0x0D, Feature.METADATA_INDEX, b"".join(self._index[0x0D])),
            (0x0A, Feature.ATTACHMENT_INDEX, b"".join(self._index[0x0A])),
            (0x08, Feature.CHUNK_INDEX, b"".join(self._index[0x08])),
        )
        return [
            (opcode, group) for opcode, feature, group in wanted if self._has(feature) and group
        ]

    def _repeated(self, records: Sequence[Record], kind: type) -> bytes:
        return b"".join(self._content(record) for record in records if isinstance(record, kind))

    def _statistics(self, records: Sequence[Record]) -> bytes:
        count = {
            kind: sum(isinstance(record, kind) for record in records)
            for kind in (Message, Schema, Channel, Attachment, Metadata)
        }
        found = [record for record in records if isinstance(record, Message)]
        times = [message.log_ns for message in found]
        fields = struct.pack("<QHI", count[Message], count[Schema], count[Channel])
        fields += struct.pack("<III", count[Attachment], count[Metadata], self._chunks)
        fields += struct.pack("<QQ", min(times, default=0), max(times, default=0))
        channels = sorted({message.channel for message in found})
        if not self._has(Feature.REPEATED_CHANNELS):
            channels = []  # a map of counts asks for the channels before it
        counts = [(number, sum(m.channel == number for m in found)) for number in channels]
        packed = b"".join(struct.pack("<HQ", *row) for row in counts)
        return self._record(0x0B, fields + struct.pack("<I", len(packed)) + packed)


def _plain(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _map(entries: Mapping[str, str]) -> bytes:
    packed = b"".join(_text(key) + _text(value) for key, value in entries.items())
    return struct.pack("<I", len(packed)) + packed


def _compressed(compression: str, content: bytes) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor().compress(content)
    if compression == "lz4":
        data: bytes = lz4.frame.compress(content)
        return data
    return content
