"""Every legal file is read as the MCAP specification says; the mcap package is a second opinion."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest
from mcap import records as package
from mcap.stream_reader import StreamReader

from shared.mcap_log import recover
from shared.mcap_log.reader import ChunkPlace, LogReader, LogRecord
from tests.shared.mcap_log.conformance import (
    CONTENTS,
    MAGIC,
    PRIVATE,
    Attachment,
    Channel,
    Feature,
    Features,
    Message,
    Metadata,
    Record,
    Schema,
    combinations,
    file_of,
)  # fmt: skip

Found = Counter[tuple[object, ...]]

COMBINATIONS = list(combinations())
UNREAD_BY_THE_PACKAGE = frozenset({Feature.CHUNK, Feature.PAD})
"""The mcap package (1.6) does not skip further fields of schemas and channels inside a chunk."""


pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


def wanted(records: Sequence[Record]) -> Found:
    """Return what a reader has to find."""
    topics = {record.number: record.topic for record in records if isinstance(record, Channel)}
    return Counter(
        _message(topics[record.channel], record) if isinstance(record, Message) else _other(record)
        for record in records
        if not isinstance(record, Schema | Channel)
    )


def _message(topic: str, row: Message) -> tuple[object, ...]:
    return (topic, row.seq, row.log_ns, row.publish_ns, row.payload)


def _other(record: Record) -> tuple[object, ...]:
    if isinstance(record, Metadata):
        return (record.name, tuple(record.entries.items()))
    assert isinstance(record, Attachment)
    return (record.name, record.content)


def found_by(records: Sequence[LogRecord]) -> Found:
    """Return what our reader finds."""
    topics: dict[int, str] = {}
    found: Found = Counter()
    for record in records:
        for value in record.values():
            _learn(value, topics, found)
        for channel, seq, log_ns, publish_ns, start, end in record.rows:
            found[topics[channel], seq, log_ns, publish_ns, record.body[start:end]] += 1
    return found


def found_by_the_package(data: bytes) -> Found:
    topics: dict[int, str] = {}
    found: Found = Counter()
    for record in StreamReader(io.BytesIO(data), validate_crcs=True).records:
        match record:
            case package.Message() as m:
                row = (m.sequence, m.log_time, m.publish_time, m.data)
                found[topics[m.channel_id], *row] += 1
            case package.DataEnd():
                return found
            case _:
                _learn(record, topics, found)
    raise AssertionError("no end of the data")


def _learn(value: object, topics: dict[int, str], found: Found) -> None:
    """Take what both readers give as the same classes."""
    match value:
        case package.Channel(id=number, topic=topic):
            topics[number] = topic
        case package.Metadata(name=name, metadata=entries):
            found[name, tuple(entries.items())] += 1
        case package.Attachment(name=name, data=content):
            found[name, content] += 1


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


def check(data: bytes, records: Sequence[Record], features: Features) -> None:
    reader = LogReader(data)
    assert found_by(list(reader)) == wanted(records)
    assert (reader.finished, reader.damage, reader.cut) == (True, [], None)
    assert bool(reader.passed_over) == (Feature.UNKNOWN in features)
    assert found_by(skimmed(data)) == wanted(records)


def test_there_are_several_hundred_files() -> None:
    assert len(COMBINATIONS) > 600
    assert {name for name, _ in COMBINATIONS} == set(CONTENTS)


@pytest.mark.parametrize("name", CONTENTS)
@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
def test_each_combination_of_features_is_read_as_the_specification_says(
    name: str, compression: str
) -> None:
    records = CONTENTS[name]
    every = [features for of, features in COMBINATIONS if of == name]
    # how a chunk is compressed does not meet the other features: some of them do
    compressed = [features for features in every if Feature.CHUNK in features][::5]
    for features in compressed if compression else every:
        for per_chunk in (2, 100)[: 2 if Feature.CHUNK in features and len(records) < 15 else 1]:
            data = file_of(records, features, compression=compression, per_chunk=per_chunk)
            if not features >= UNREAD_BY_THE_PACKAGE:
                assert found_by_the_package(data) == wanted(records), features
            check(data, records, features)


@pytest.mark.parametrize("name", CONTENTS)
def test_each_is_recovered_to_a_file_with_the_same_in_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / "foreign.mcap"
    for features in [features for of, features in COMBINATIONS if of == name][::6]:
        path.write_bytes(file_of(CONTENTS[name], features, per_chunk=3))
        outcome = recover.recover(path, tmp_path / "copy.mcap")
        assert (outcome.damage, outcome.cut, outcome.orphans) == ((), None, 0)
        data = outcome.out.read_bytes()
        readers = [lambda data: found_by(list(LogReader(data))), found_by_the_package]
        for read in readers[: 1 if features >= UNREAD_BY_THE_PACKAGE else 2]:
            found = read(data)
            assert not wanted(CONTENTS[name]) - found
            added = list(found - wanted(CONTENTS[name]))
            assert [row[0] for row in added] == ["recovered"]
        assert recover.is_whole(outcome.out)


@pytest.mark.parametrize("features", [frozenset(), frozenset({Feature.UNKNOWN, Feature.PAD})])
def test_a_file_cut_anywhere_keeps_the_messages_before_the_cut(features: Features) -> None:
    records = CONTENTS["ten_messages"]
    data = file_of(records, features)
    ends = [
        data.index(_record_of(message)) + len(_record_of(message))
        for message in records
        if isinstance(message, Message)
    ]
    for size in range(len(MAGIC), len(data)):
        reader = LogReader(data[:size])
        count = sum(len(record.rows) for record in reader)
        assert count == sum(end <= size for end in ends), size
        assert not reader.damage


def test_a_chunk_before_a_cut_is_told_with_all_of_its_channels_or_none() -> None:
    """The last index of a killed file was passed over, and an event that it told of not found."""
    messages = Message(1, 1, 1, 1, b""), Message(2, 1, 2, 2, b"")
    records = (Channel(1, 0, "a"), Channel(2, 0, "b"), *messages)
    data = file_of(records, frozenset({Feature.CHUNK, Feature.MESSAGE_INDEX}), per_chunk=2)
    first_index = data.index(struct.pack("<BQH", 0x07, 6 + 16, 1))
    for size in range(first_index, len(data)):
        skimmed(data[:size])


def _record_of(message: Message) -> bytes:
    data = file_of([message], frozenset())
    start = data.index(b"by hand") + len(b"by hand")
    return data[start : data.index(b"\x0f\x04\0\0\0\0\0\0\0", start)]


def test_messages_without_chunks_are_read_in_pieces_not_one_by_one() -> None:
    many = [Message(1, seq, seq, seq, bytes(100)) for seq in range(30_000)]
    data = file_of([Channel(1, 0, "a"), *many], frozenset())
    places = [found for found in LogReader(data).skim() if isinstance(found, ChunkPlace)]
    assert len(places) == 4  # of 1 MiB
    reader = LogReader(data)
    assert sum(len(row.rows) for place in places if (row := reader.read_at(place.start))) == 30_000


def test_a_chunk_whose_kind_is_flipped_to_a_private_one_is_damage() -> None:
    features = frozenset({Feature.CHUNK, Feature.MESSAGE_INDEX})
    data = bytearray(file_of(CONTENTS["ten_messages"], features))
    at = data.index(b"by hand") + len(b"by hand")
    assert data[at] == 0x06
    data[at] |= PRIVATE
    reader = LogReader(bytes(data))
    assert not any(record.rows for record in reader)
    assert (len(reader.damage), reader.passed_over) == (1, 0)


def test_a_length_that_swallows_the_next_records_is_no_later_field() -> None:
    features = frozenset({Feature.CHUNK, Feature.MESSAGE_INDEX})
    data = bytearray(file_of(CONTENTS["ten_messages"], features, compression="zstd", per_chunk=4))
    first = data.index(struct.pack("<BQHI", 0x07, 6 + 32, 1, 32))  # behind the first chunk
    data[first + 1] += 30
    reader = LogReader(bytes(data))
    assert sum(len(record.rows) for record in reader) == 10
    assert len(reader.damage) == 1
