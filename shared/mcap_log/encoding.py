"""MCAP chunks and the end of a file, written without the mcap package's writer. Pure.

That writer cannot copy a chunk that exists already, and recovery consists of that: chunks stay as
they are, byte for byte, and get the index that they lack. Adding each message again cost 36 us a
message.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping

import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer, SummaryOffset

from shared.mcap_log.records import MAGIC, encode, with_prefix

_CRC_SIZE = 4


def compressed_chunk(first_ns: int, last_ns: int, content: bytes) -> Chunk:
    """Return a zstd chunk of these records.

    Args:
        first_ns: log time of its first message.
        last_ns: log time of its last.
        content: records, one after the other.
    """
    return Chunk(
        compression="zstd",
        data=zstandard.ZstdCompressor().compress(content),
        message_start_time=first_ns,
        message_end_time=last_ns,
        uncompressed_size=len(content),
        uncompressed_crc=zlib.crc32(content),
    )


def message_index(channel_id: int, rows: Iterable[tuple[int, int]]) -> bytes:
    """Return the record that says where a channel's messages are in their chunk.

    Args:
        channel_id: of the channel.
        rows: log time and offset in the decompressed chunk, of each message.
    """
    entries = b"".join(struct.pack("<QQ", *row) for row in rows)
    return with_prefix(Opcode.MESSAGE_INDEX, struct.pack("<HI", channel_id, len(entries)) + entries)


def file_end(position: int, groups: Mapping[int, bytes]) -> bytes:
    """Return what follows the last message of a finished file: data end, summary, footer, magic.

    Args:
        position: offset in the file at which this begins.
        groups: records of the summary by opcode, joined.
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
    without_crc = encode(footer)[:-_CRC_SIZE]
    footer.summary_crc = zlib.crc32(summary + offsets + without_crc)
    return data_end + summary + offsets + encode(footer) + MAGIC
