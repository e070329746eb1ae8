"""Encode MCAP records, and decode them without trusting them. Pure.

The records are the classes of the mcap package. Its own readers trust each length: a wrong one
makes them read on, allocate or raise (docs/logs.md). Here a record is valid only if its fields fit
into its length; every other record is `Malformed`. Bytes after the last field belong to a later
version of the format, which lets a reader skip them.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from types import MappingProxyType
from typing import Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    Schema,
    SummaryOffset,
)

__all__ = ["Attachment", "Channel", "Chunk", "Header", "McapRecord", "Metadata", "Schema"]
"""Classes of the mcap package, for importers of this module."""

MAGIC: Final = b"\x89MCAP0\r\n"

PREFIX: Final = struct.Struct("<BQ")
"""Start of every record: opcode, length of the rest."""
MESSAGE_RECORD: Final = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; then the payload."""
CHUNK_TIMES: Final = struct.Struct("<QQQI")
"""First log time, last log time, size and CRC before compression."""
CRC: Final = struct.Struct("<I")

ZSTD_LEVEL: Final = 8
"""Rows of unrounded measurements are smallest at level 1 (findings/zstd_level_of_json_rows.sh).
Ours are rounded. At levels 2 to 4 they are larger as well, but at level 8 the chunks are 14 %
smaller and take six times the time, 2 % of a core."""
DECOMPRESSED_MAX: Final = 1 << 26
"""Maximum decompressed size of a chunk, bytes, unless its compressed size allows more: a flipped
bit can claim exabytes."""
EXPANSION_MAX: Final = 50
"""Maximum expansion of compressed bytes; a run's chunks expand four to ten times."""
_WINDOW_MAX: Final = 1 << 27
_STEP: Final = 1 << 16

_TYPES: Final[Mapping[int, type[McapRecord]]] = MappingProxyType(
    {
        Opcode.HEADER: Header,
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
        Opcode.METADATA: Metadata,
        Opcode.ATTACHMENT: Attachment,
        Opcode.DATA_END: DataEnd,
    }
)
KNOWN: Final = frozenset({*_TYPES, Opcode.MESSAGE_INDEX, Opcode.CHUNK, Opcode.MESSAGE})
"""Opcodes of a file's data section."""


class Malformed(Exception):  # noqa: N818 - a finding about a file, never shown as an error
    """The bytes of a record do not fit its opcode and length."""


class _Fields(ReadDataStream):
    """Fields of a record, never read beyond its end."""

    def __init__(self, body: bytes) -> None:
        super().__init__(BytesIO(body))
        self._size = len(body)

    def read(self, length: int) -> bytes:
        if length > self._size - self.count:
            raise Malformed
        return super().read(length)


def encode(record: McapRecord) -> bytes:
    """Return a record's bytes, with opcode and length."""
    builder = RecordBuilder()
    record.write(builder)
    end: Callable[[], bytes] = builder.end  # mcap leaves it without annotations
    return end()


def with_prefix(opcode: int, body: bytes) -> bytes:
    """Return a record's bytes: opcode, length and content."""
    return PREFIX.pack(opcode, len(body)) + body


def compressed_chunk(first_ns: int, last_ns: int, content: bytes) -> Chunk:
    """Return a zstd chunk of these records, with its messages' first and last log times."""
    return Chunk(
        compression="zstd",
        data=zstandard.compress(content, ZSTD_LEVEL),
        message_start_time=first_ns,
        message_end_time=last_ns,
        uncompressed_size=len(content),
        uncompressed_crc=zlib.crc32(content),
    )


def message_index(channel_id: int, rows: Iterable[tuple[int, int]]) -> bytes:
    """Return the index record of a channel's messages in their chunk.

    `rows` has each message's log time, and its offset in the decompressed chunk.
    """
    entries = b"".join(struct.pack("<QQ", *row) for row in rows)
    return with_prefix(Opcode.MESSAGE_INDEX, struct.pack("<HI", channel_id, len(entries)) + entries)


def file_end(position: int, groups: Mapping[int, bytes]) -> bytes:
    """Return the bytes after the last message of a finished file: data end, summary, footer, magic.

    They begin at the offset `position`; `groups` are the records of the summary by opcode, joined.
    """
    data_end = encode(DataEnd(data_section_crc=0))
    summary_start = position + len(data_end)
    summary, offsets = b"", b""
    for opcode, records in groups.items():
        if records:
            start = summary_start + len(summary)
            offsets += encode(
                SummaryOffset(group_opcode=opcode, group_start=start, group_length=len(records))
            )
            summary += records
    footer = Footer(
        summary_start=summary_start,
        summary_offset_start=summary_start + len(summary),
        summary_crc=0,
    )
    without_crc = encode(footer)[: -CRC.size]
    footer.summary_crc = zlib.crc32(summary + offsets + without_crc)
    return data_end + summary + offsets + encode(footer) + MAGIC


def decode(opcode: int, body: bytes) -> tuple[McapRecord | None, int]:
    """Decode a record of the data section that is neither chunk nor message.

    Returns the record (None for a message index, of which only the length is checked) and the size
    of its fields; fields of a later version may follow. Raises Malformed if the content does not
    fit the opcode or the length, or its CRC is wrong.
    """
    if opcode == Opcode.MESSAGE_INDEX:
        size = 6 + int.from_bytes(body[2:6], "little")
        if len(body) < size:
            raise Malformed
        return None, size
    kind = _TYPES.get(opcode)
    if kind is None:
        raise Malformed
    fields = _Fields(body)
    try:
        found: McapRecord = kind.read(fields)  # type: ignore[attr-defined]
    except UnicodeDecodeError:
        raise Malformed from None
    if isinstance(found, Attachment):
        crc_at = fields.count - CRC.size
        if CRC.unpack_from(body, crc_at)[0] not in (0, zlib.crc32(body[:crc_at])):
            raise Malformed
    elif not isinstance(found, Header) and not body.startswith(encode(found)[PREFIX.size :]):
        raise Malformed  # a map's length does not fit its pairs
    return found, fields.count


def decode_chunk(body: bytes, *, cut: bool = False) -> tuple[Chunk, int]:
    """Decode a chunk, whose data stays compressed. Return it, and the size of its fields.

    `cut`: the file ends inside the chunk, so its data is incomplete. Raises Malformed if the head
    is invalid or, without `cut`, the data is incomplete.
    """
    fields = _Fields(body)
    first_ns, last_ns, size, crc = CHUNK_TIMES.unpack(fields.read(CHUNK_TIMES.size))
    try:
        compression = fields.read_prefixed_string()
    except UnicodeDecodeError:
        raise Malformed from None
    length = fields.read8()
    data = body[fields.count : fields.count + length]
    if len(data) < length and not cut:
        raise Malformed
    chunk = Chunk(
        compression=compression,
        data=data,
        message_start_time=first_ns,
        message_end_time=last_ns,
        uncompressed_size=size,
        uncompressed_crc=crc,
    )
    return chunk, fields.count + length


def decompressed(chunk: Chunk) -> bytes:
    """Return a chunk's records, decompressed.

    Raises Malformed if they cannot be decompressed, or their size or CRC differs from the head's.
    """
    if chunk.uncompressed_size > max(DECOMPRESSED_MAX, EXPANSION_MAX * len(chunk.data)):
        raise Malformed
    if chunk.compression == "":
        data = bytes(chunk.data)
    elif chunk.compression == "zstd":
        data = _from_zstd(chunk)
    elif chunk.compression == "lz4":
        data = _from_lz4(chunk)
    else:
        raise Malformed
    crc = chunk.uncompressed_crc
    if len(data) != chunk.uncompressed_size or (crc and zlib.crc32(data) != crc):
        raise Malformed
    return data


def decompressed_start(chunk: Chunk) -> bytes:
    """Return the readable start of a chunk whose end is missing; no CRC covers it.

    zstd decompresses blocks of up to 128 KiB; data after the last whole block is lost. lz4, which
    this project does not write, is not read.
    """
    size = chunk.uncompressed_size
    if size > DECOMPRESSED_MAX or chunk.compression not in ("", "zstd"):
        raise Malformed
    if chunk.compression == "":
        return bytes(chunk.data[:size])
    reader = zstandard.ZstdDecompressor(max_window_size=_WINDOW_MAX).stream_reader(chunk.data)
    pieces, left = [], size
    with contextlib.suppress(zstandard.ZstdError):
        while left > 0 and (piece := reader.read(min(left, _STEP))):
            pieces.append(piece)
            left -= len(piece)
    return b"".join(pieces)


def _from_zstd(chunk: Chunk) -> bytes:
    try:
        stated = zstandard.get_frame_parameters(chunk.data).content_size
        if stated not in (chunk.uncompressed_size, zstandard.CONTENTSIZE_UNKNOWN):
            raise Malformed
        decompressor = zstandard.ZstdDecompressor(max_window_size=_WINDOW_MAX)
        return decompressor.decompress(chunk.data, max_output_size=chunk.uncompressed_size)
    except zstandard.ZstdError:
        raise Malformed from None


def _from_lz4(chunk: Chunk) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    try:
        data: bytes = decompressor.decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
    except (RuntimeError, EOFError):
        raise Malformed from None
    if not decompressor.eof:
        raise Malformed
    return data


class ChunkMessage(NamedTuple):
    """One message of a chunk: its head, and where its payload is in the decompressed data."""

    channel_id: int
    seq: int
    log_ns: int
    publish_ns: int
    start: int
    end: int


def split_messages(
    data: bytes | mmap.mmap, at: int, end: int, *, enough: float = math.inf, origin: int = 0
) -> tuple[list[ChunkMessage], int]:
    """Return consecutive messages from `at` on, and where they end.

    Their offsets count from `origin`. A message that does not fit before `end`, or is too short, is
    left out with all after it; after `enough` bytes no further message is returned.
    """
    rows: list[ChunkMessage] = []
    begin, new, message, head = at, ChunkMessage._make, int(Opcode.MESSAGE), MESSAGE_RECORD
    while at - begin < enough and at + head.size <= end and data[at] == message:
        _, length, *fields = head.unpack_from(data, at)
        start, following = at + head.size, at + PREFIX.size + length
        if not start <= following <= end:
            break
        rows.append(new((*fields, start - origin, following - origin)))
        at = following
    return rows, at


class _ChunkContent(NamedTuple):
    """Readable records of a chunk."""

    rows: list[ChunkMessage]
    others: list[tuple[int, bytes]]
    """Opcode and body of each record that is not a message."""
    whole: bool
    """True if the records fill the chunk. Its CRC does not prove that: a writer that fails in the
    middle of a record, and continues, computes the CRC over what it has written."""


def split_chunk(data: bytes, places: Sequence[int] = ()) -> _ChunkContent:
    """Split a chunk's decompressed data into its records.

    `places` are the offsets of its messages, in order, if known. After an incomplete record,
    reading continues at the next of them.
    """
    others: list[tuple[int, bytes]] = []
    whole = True
    rows, at = split_messages(data, 0, len(data))
    while at < len(data):
        opcode, start, end = 0, at + PREFIX.size, len(data) + 1
        if start <= len(data):
            opcode, length = PREFIX.unpack_from(data, at)
            end = start + length
        if end <= len(data) and opcode != Opcode.MESSAGE:
            others.append((opcode, data[start:end]))
            at = end
        else:
            whole = False
            at = next((place for place in places if place > at), len(data))
        found, at = split_messages(data, at, len(data))
        rows += found
    return _ChunkContent(rows, others, whole)
