"""MCAP records written without the mcap package's writer. Pure.

That writer cannot take over a chunk that is written already, which is what recovery is
made of: the chunks stay as they are, byte for byte, and get the index that they lack.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import zstandard

from services.recorder import mcap_records as mcap
from services.recorder.mcap_records import Attachment, Chunk


def _text(value: str) -> bytes:
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def record(opcode: int, body: bytes) -> bytes:
    """Return a whole record."""
    return mcap.PREFIX.pack(opcode, len(body)) + body


def header_record(profile: str, library: str) -> bytes:
    """Return the record at the start of a file."""
    return record(mcap.HEADER, _text(profile) + _text(library))


def metadata_body(name: str, entries: Mapping[str, str]) -> bytes:
    """Return the content of a metadata record."""
    pairs = b"".join(_text(key) + _text(value) for key, value in entries.items())
    return _text(name) + struct.pack("<I", len(pairs)) + pairs


def chunk_record(first_ns: int, last_ns: int, content: bytes) -> bytes:
    """Return a zstd chunk with these records in it."""
    packed = zstandard.ZstdCompressor().compress(content)
    times = mcap.CHUNK_TIMES.pack(first_ns, last_ns, len(content), zlib.crc32(content))
    return record(mcap.CHUNK, times + _text("zstd") + struct.pack("<Q", len(packed)) + packed)


def without_schema(channel: bytes) -> bytes:
    """Return a channel's record content with no schema named."""
    return channel[:2] + b"\0\0" + channel[4:]


def message_index_record(channel_id: int, rows: Iterable[tuple[int, int]]) -> bytes:
    """Return where in its chunk a channel's messages are, as (log time, offset)."""
    body = b"".join(struct.pack("<QQ", *row) for row in rows)
    return record(mcap.MESSAGE_INDEX, struct.pack("<HI", channel_id, len(body)) + body)


def chunk_index_record(
    found: Chunk, place: tuple[int, int], index_offsets: Mapping[int, int], index_length: int
) -> bytes:
    """Return where a chunk is.

    Args:
        found: the chunk.
        place: start and length of its record in the file.
        index_offsets: where the message index of each channel is in the file.
        index_length: of the chunk's message indexes together.
    """
    offsets = b"".join(struct.pack("<HQ", *row) for row in index_offsets.items())
    return record(
        mcap.CHUNK_INDEX,
        struct.pack("<QQQQI", found.first_ns, found.last_ns, *place, len(offsets))
        + offsets
        + struct.pack("<Q", index_length)
        + _text(found.compression)
        + struct.pack("<QQ", len(found.content), found.size),
    )


def attachment_index_record(place: tuple[int, int], found: Attachment) -> bytes:
    """Return where an attachment is: start and length of its record."""
    times = struct.pack("<QQQQ", *place, found.log_time, found.create_time)
    size = struct.pack("<Q", len(found.data))
    return record(mcap.ATTACHMENT_INDEX, times + size + _text(found.name) + _text(found.media_type))


def metadata_index_record(place: tuple[int, int], name: str) -> bytes:
    """Return where a metadata record is: start and length."""
    return record(mcap.METADATA_INDEX, struct.pack("<QQ", *place) + _text(name))


class Totals(NamedTuple):
    """What a file holds; the fields stand in the order of the record."""

    messages: int
    schemas: int
    channels: int
    attachments: int
    metadata: int
    chunks: int
    first_ns: int
    last_ns: int


def statistics_record(totals: Totals, per_channel: Mapping[int, int]) -> bytes:
    """Return the counts of a file."""
    counts = b"".join(struct.pack("<HQ", *row) for row in per_channel.items())
    return record(mcap.STATISTICS, struct.pack("<QHIIIIQQI", *totals, len(counts)) + counts)


def ending(position: int, groups: Mapping[int, bytes]) -> bytes:
    """Return all that stands behind the last message: data end, summary, footer, magic.

    Args:
        position: of the first byte of this in the file.
        groups: records of the summary by opcode, joined.
    """
    data_end = record(mcap.DATA_END, struct.pack("<I", 0))
    summary_start = position + len(data_end)
    summary, offsets = b"", b""
    for opcode, records in groups.items():
        if records:
            start = summary_start + len(summary)
            offsets += record(mcap.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start, len(records)))
            summary += records
    places = struct.pack("<QQ", summary_start, summary_start + len(summary))
    footer = mcap.PREFIX.pack(mcap.FOOTER, 20) + places
    crc = zlib.crc32(summary + offsets + footer)
    return data_end + summary + offsets + footer + struct.pack("<I", crc) + mcap.MAGIC
