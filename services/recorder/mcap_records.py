"""MCAP records as bytes, decoded without trusting one of them. Pure.

The mcap package reads what is right: a wrong length makes it read on, allocate or
stumble (docs/logs.md). Here a record is decoded only if it fits its length to the
byte; everything else is `Malformed`.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from typing import Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

MAGIC: Final = b"\x89MCAP0\r\n"

HEADER: Final = 0x01
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
MESSAGE_INDEX: Final = 0x07
CHUNK_INDEX: Final = 0x08
ATTACHMENT: Final = 0x09
ATTACHMENT_INDEX: Final = 0x0A
STATISTICS: Final = 0x0B
METADATA: Final = 0x0C
METADATA_INDEX: Final = 0x0D
SUMMARY_OFFSET: Final = 0x0E
DATA_END: Final = 0x0F

PREFIX: Final = struct.Struct("<BQ")
"""Every record: opcode, length of what follows."""
MESSAGE_RECORD: Final = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; then the payload."""
CHUNK_TIMES: Final = struct.Struct("<QQQI")
"""First log time, last log time, size and CRC before compression."""

INFLATED_MAX: Final = 1 << 28
"""Larger chunks are refused: a flipped bit in a size asks for exabytes."""
_WINDOW_MAX: Final = 1 << 27
_PIECE: Final = 1 << 16


class Malformed(Exception):  # noqa: N818 - a finding about a file, never shown as an error
    """A record's bytes are not what its opcode and length say."""


class Schema(NamedTuple):
    """How the messages of some channels look."""

    id: int
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """One topic of one sender."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class Attachment(NamedTuple):
    """A file within the file."""

    log_time: int
    create_time: int
    name: str
    media_type: str
    data: bytes


class Chunk(NamedTuple):
    """A chunk's head and its content as it stands in the file."""

    first_ns: int
    last_ns: int
    size: int
    """Size of the content before compression, bytes."""
    crc: int
    """CRC of the content before compression; 0 if there is none."""
    compression: str
    content: bytes


class _Cursor:
    """Reads fields one after the other; never beyond the end."""

    def __init__(self, body: bytes) -> None:
        self._body = body
        self.at = 0

    def take(self, length: int) -> bytes:
        if length > len(self._body) - self.at:
            raise Malformed
        self.at += length
        return self._body[self.at - length : self.at]

    def u16(self) -> int:
        return int.from_bytes(self.take(2), "little")

    def u32(self) -> int:
        return int.from_bytes(self.take(4), "little")

    def u64(self) -> int:
        return int.from_bytes(self.take(8), "little")

    def text(self) -> str:
        try:
            return self.take(self.u32()).decode()
        except UnicodeDecodeError:
            raise Malformed from None

    def texts(self) -> dict[str, str]:
        end = self.u32() + self.at
        found = {}
        while self.at < end:
            name = self.text()
            found[name] = self.text()
        if self.at != end:
            raise Malformed
        return found

    def end(self) -> None:
        if self.at != len(self._body):
            raise Malformed


def header(body: bytes) -> tuple[str, str]:
    """Return (profile, library)."""
    cursor = _Cursor(body)
    return cursor.text(), cursor.text()


def schema(body: bytes) -> Schema:
    """Decode a schema record."""
    cursor = _Cursor(body)
    found = Schema(cursor.u16(), cursor.text(), cursor.text(), cursor.take(cursor.u32()))
    cursor.end()
    return found


def channel(body: bytes) -> Channel:
    """Decode a channel record."""
    cursor = _Cursor(body)
    found = Channel(cursor.u16(), cursor.u16(), cursor.text(), cursor.text(), cursor.texts())
    cursor.end()
    return found


def metadata(body: bytes) -> tuple[str, dict[str, str]]:
    """Return (name, entries)."""
    cursor = _Cursor(body)
    found = cursor.text(), cursor.texts()
    cursor.end()
    return found


def attachment(body: bytes) -> Attachment:
    """Decode an attachment; its CRC is checked if it has one."""
    cursor = _Cursor(body)
    found = Attachment(
        cursor.u64(), cursor.u64(), cursor.text(), cursor.text(), cursor.take(cursor.u64())
    )
    crc = zlib.crc32(body[: cursor.at])
    if cursor.u32() not in (0, crc):
        raise Malformed
    cursor.end()
    return found


def message_index(body: bytes) -> None:
    """Check that a message index is whole."""
    cursor = _Cursor(body)
    cursor.u16()
    cursor.take(cursor.u32())
    cursor.end()


def data_end(body: bytes) -> None:
    """Check that the record behind the last message is one."""
    cursor = _Cursor(body)
    cursor.u32()
    cursor.end()


def chunk(body: bytes, *, cut: bool = False) -> Chunk:
    """Decode a chunk's head.

    Args:
        body: of the record.
        cut: the file ends within the chunk, so `content` is what there is of it.
    """
    cursor = _Cursor(body)
    first_ns, last_ns, size, crc = CHUNK_TIMES.unpack(cursor.take(CHUNK_TIMES.size))
    compression = cursor.text()
    length = cursor.u64()
    rest = body[cursor.at :]
    if length < len(rest) or (length > len(rest) and not cut):
        raise Malformed
    return Chunk(first_ns, last_ns, size, crc, compression, rest)


def inflated(found: Chunk) -> bytes:
    """Return a chunk's records, as many as were said and with the right CRC."""
    if found.size > INFLATED_MAX:
        raise Malformed
    if found.compression == "":
        data = found.content
    elif found.compression == "zstd":
        data = _unzstd(found)
    elif found.compression == "lz4":
        data = _unlz4(found)
    else:
        raise Malformed
    if len(data) != found.size or (found.crc and zlib.crc32(data) != found.crc):
        raise Malformed
    return data


def inflated_start(found: Chunk) -> bytes:
    """Return what can be read of a chunk whose end is missing; no CRC vouches for it.

    zstd decompresses by blocks of up to 128 KiB: what is behind the last whole block is
    lost. Of lz4, which this project does not write, nothing is taken.
    """
    if found.size > INFLATED_MAX or found.compression not in ("", "zstd"):
        raise Malformed
    if found.compression == "":
        return found.content[: found.size]
    reader = zstandard.ZstdDecompressor(max_window_size=_WINDOW_MAX).stream_reader(found.content)
    pieces, left = [], found.size
    with contextlib.suppress(zstandard.ZstdError):
        while left > 0 and (piece := reader.read(min(left, _PIECE))):
            pieces.append(piece)
            left -= len(piece)
    return b"".join(pieces)


def _unzstd(found: Chunk) -> bytes:
    try:
        said = zstandard.get_frame_parameters(found.content).content_size
        if said not in (found.size, zstandard.CONTENTSIZE_UNKNOWN):
            raise Malformed
        decompressor = zstandard.ZstdDecompressor(max_window_size=_WINDOW_MAX)
        return decompressor.decompress(found.content, max_output_size=found.size)
    except zstandard.ZstdError:
        raise Malformed from None


def _unlz4(found: Chunk) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    try:
        data: bytes = decompressor.decompress(found.content, max_length=found.size + 1)
    except (RuntimeError, EOFError):
        raise Malformed from None
    if not decompressor.eof:
        raise Malformed
    return data


class ChunkMessage(NamedTuple):
    """One message of a chunk: its head, and where its payload is in the content."""

    channel_id: int
    seq: int
    log_ns: int
    publish_ns: int
    start: int
    end: int


def contents(data: bytes) -> tuple[list[ChunkMessage], list[tuple[int, bytes]]]:
    """Return the messages, and the other records as (opcode, body), of a chunk's content.

    What is not whole at the end is left out, so this reads the start of a cut chunk too.
    """
    rows: list[ChunkMessage] = []
    others: list[tuple[int, bytes]] = []
    at, size, new = 0, len(data), ChunkMessage._make
    head, prefix = MESSAGE_RECORD, PREFIX
    while at + prefix.size <= size:
        if data[at] == MESSAGE and at + head.size <= size:
            _, length, *fields = head.unpack_from(data, at)
            start, at = at + head.size, at + prefix.size + length
            if at > size or start > at:
                break
            rows.append(new((*fields, start, at)))
        else:
            opcode, length = prefix.unpack_from(data, at)
            start, at = at + prefix.size, at + prefix.size + length
            if at > size:
                break
            others.append((opcode, data[start:at]))
    return rows, others
