"""Every legal file is read as the MCAP specification says; the mcap package writes them."""

from __future__ import annotations

import io
import itertools
import struct
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pytest
from mcap import records as package
from mcap.writer import CompressionType, IndexType, Writer

from shared.mcap_log import recover
from shared.mcap_log.reader import ChunkPlace, LogReader, LogRecord

Found = Counter[tuple[object, ...]]
Message = tuple[str, int, int, int, bytes]

FLAGS = ("use_chunking", "repeat_channels", "use_statistics", "use_summary_offsets")
INDICES = (IndexType.ALL, IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE)
PLAIN: Final = dict.fromkeys((*FLAGS, "repeat_schemas"), False) | {"index_types": IndexType.NONE}
"""Without a summary, so that bytes may be added before it."""
TIMES = (1, 3, 2, 4, 4, 6, 5, 8, 9, 10)
MESSAGES: Sequence[Message] = [
    *(("described", n, at_ns, at_ns + 1, b"payload %d" % n) for n, at_ns in enumerate(TIMES)),
    ("plain", 0, 11, 11, b""),
]

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


def file_of(messages: Sequence[Message] = MESSAGES, **how: Any) -> bytes:
    """Return a finished file with two channels, an attachment and two entries of metadata."""
    file = io.BytesIO()
    writer = Writer(file, **how)
    writer.start()
    writer.add_metadata("about", {"foo": "bar"})
    schema = writer.register_schema("Example", "c", b"\4\5\6")
    channels = {
        "described": writer.register_channel("described", "a", schema, {"foo": "bar"}),
        "plain": writer.register_channel("plain", "a", 0),
    }
    for topic, seq, log_ns, publish_ns, payload in messages:
        writer.add_message(channels[topic], log_ns, payload, publish_ns, seq)
    writer.add_attachment(1, 2, "file", "application/octet-stream", b"\1\2\3")
    writer.add_metadata("at the end", {})
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


WANTED: Found = Counter(
    [*MESSAGES, ("file", b"\1\2\3"), ("about", (("foo", "bar"),)), ("at the end", ())]
)


def found_by(records: Sequence[LogRecord]) -> Found:
    topics: dict[int, str] = {}
    found: Found = Counter()
    for record in records:
        for value in record.values():
            match value:
                case package.Channel(id=number, topic=topic):
                    topics[number] = topic
                case package.Metadata(name=name, metadata=entries):
                    found[name, tuple(entries.items())] += 1
                case package.Attachment(name=name, data=content):
                    found[name, content] += 1
        for channel, seq, log_ns, publish_ns, start, end in record.rows:
            found[topics[channel], seq, log_ns, publish_ns, record.body[start:end]] += 1
    return found


def skimmed(data: bytes) -> list[LogRecord]:
    """Return the records as a run's index finds them: places first, read by another reader."""
    reader, later, found = LogReader(data), LogReader(data), []
    for one in reader.skim():
        read = later.read_at(one.start) if isinstance(one, ChunkPlace) else one
        assert read is not None
        if isinstance(one, ChunkPlace):
            times = [row.log_ns for row in read.rows]
            assert (one.first_ns, one.last_ns) == (min(times), max(times))
            assert one.channels in (None, {row.channel_id for row in read.rows})
        found.append(read)
    assert not reader.damage
    assert not later.damage
    return found


def combinations() -> list[dict[str, Any]]:
    flags = itertools.product((True, False), repeat=len(FLAGS))
    return [
        dict(zip(FLAGS, chosen, strict=True)) | {"index_types": index, "repeat_schemas": chosen[1]}
        for chosen, index in itertools.product(flags, INDICES)
    ]


@pytest.mark.parametrize("chunk_size", [60, 1 << 20])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_each_combination_of_features_is_read_and_recovered(
    tmp_path: Path, compression: CompressionType, chunk_size: int
) -> None:
    path = tmp_path / "foreign.mcap"
    for number, how in enumerate(combinations()):
        data = file_of(compression=compression, chunk_size=chunk_size, **how)
        reader = LogReader(data)
        assert found_by(list(reader)) == WANTED, how
        assert (reader.finished, reader.damage, reader.cut) == (True, [], None)
        assert found_by(skimmed(data)) == WANTED
        if number % 6:
            continue
        path.write_bytes(data)
        outcome = recover.recover(path, tmp_path / "copy.mcap")
        assert (outcome.damage, outcome.cut, outcome.orphans) == ((), None, 0)
        found = found_by(list(LogReader(outcome.out.read_bytes())))
        assert [row[0] for row in found - WANTED] == ["recovered"]
        assert not WANTED - found
        assert recover.is_whole(outcome.out)


def after_header(data: bytes) -> int:
    return 8 + 9 + int.from_bytes(data[9:17], "little")


@pytest.mark.parametrize("opcode", [0x80, 0x3F, 0xFF], ids=["private", "reserved", "last"])
def test_records_of_unknown_kinds_are_passed_over(opcode: int) -> None:
    data = file_of(**PLAIN)
    at = after_header(data)
    unknown = struct.pack("<BQ", opcode, 50) + bytes(50)
    reader = LogReader(data[:at] + unknown + data[at:])
    assert found_by(list(reader)) == WANTED
    assert (reader.finished, reader.damage) == (True, [])
    assert reader.passed_over


def test_a_file_cut_anywhere_keeps_the_messages_before_the_cut() -> None:
    data = file_of(MESSAGES[:-1], **PLAIN)
    ends = [data.index(message[-1]) + len(message[-1]) for message in MESSAGES[:-1]]
    for size in range(8, len(data)):
        reader = LogReader(data[:size])
        count = sum(len(record.rows) for record in reader)
        assert count == sum(end <= size for end in ends), size
        assert not reader.damage


def test_a_chunk_before_a_cut_is_told_with_all_of_its_channels_or_none() -> None:
    """The last index of a killed file was passed over, and an event that it told of not found."""
    data = file_of([MESSAGES[0], MESSAGES[-1]])
    first_index = data.index(struct.pack("<BQH", 0x07, 6 + 16, 1))
    for size in range(first_index, len(data)):
        skimmed(data[:size])


def test_messages_without_chunks_are_read_in_pieces_not_one_by_one() -> None:
    data = file_of([("plain", seq, seq, seq, bytes(100)) for seq in range(30_000)], **PLAIN)
    places = [found for found in LogReader(data).skim() if isinstance(found, ChunkPlace)]
    assert len(places) == 4  # of 1 MiB
    reader = LogReader(data)
    assert sum(len(row.rows) for place in places if (row := reader.read_at(place.start))) == 30_000


def test_a_chunk_whose_kind_or_length_is_damaged_is_damage() -> None:
    """A kind flipped to a private one is none of a later version, a long length no later field."""
    data = bytearray(file_of(chunk_size=60))
    at = data.index(b"zstd") - 41
    assert data[at] == 0x06
    data[at] |= 0x80
    reader = LogReader(bytes(data))
    first = sum(len(record.rows) for record in reader)
    assert 0 < first < len(MESSAGES)
    assert (len(reader.damage), reader.passed_over) == (1, 0)
    data[at] &= ~0x80
    data[data.index(struct.pack("<BQ", 0x07, 6 + 2 * 16)) + 1] += 30
    reader = LogReader(bytes(data))
    assert sum(len(record.rows) for record in reader) == len(MESSAGES)
    assert len(reader.damage) == 1
