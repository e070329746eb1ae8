from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import StreamReader

from shared.bus import codec, topics
from shared.exceptions import RunError
from shared.mcap_log import files
from shared.mcap_log.records import ZSTD_LEVEL
from tests.messages import sample
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import (
    ATTACHMENTS,
    OFFSET_NS,
    STATE_KEY,
    Queue,
    by_the_package,
    item,
)
from tools.logs.run_log import read_run


def test_metadata_and_attachments_come_before_the_first_chunk(tmp_path: Path) -> None:
    path = runs.write(tmp_path, [item(seq) for seq in range(500)])
    with path.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True).records)
    assert isinstance(records[0], Header)
    first_chunk = next(i for i, record in enumerate(records) if isinstance(record, Chunk))
    head = records[1:first_chunk]
    names = [r.name for r in head if isinstance(r, Metadata | Attachment)]
    assert names == ["run", "packages", "clock", "split", *ATTACHMENTS]
    described = [r for r in head if isinstance(r, Schema | Channel)]
    assert len(names) + len(described) == len(head)
    topics_described = {r.topic for r in described if isinstance(r, Channel)}
    assert topics_described == set(topics.recorded_keys(runs.ROBOT))
    rows = records[first_chunk].data
    assert rows == zstandard.compress(zstandard.decompress(rows), ZSTD_LEVEL), "not mcap's level"


def leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, dict | list) and value:
        for entry in value.values() if isinstance(value, dict) else value:
            yield from leaves(entry)
    else:
        yield value


def test_a_plotter_gets_every_value_of_every_topic(tmp_path: Path) -> None:
    """PlotJuggler drops null and empty arrays, cuts long ones, and makes doubles of integers."""
    rows = [
        (key, codec.encode(sample(topic.type, seq=seq, t_ns=seq)), seq)
        for seq in range(3)
        for key, topic in topics.recorded_keys(runs.ROBOT).items()
    ]
    path = runs.write(tmp_path, rows)
    assert len(by_the_package(path)) == len(rows)
    with path.open("rb") as file:
        for described, channel, message in make_reader(file).iter_messages():
            assert described is not None
            values = list(leaves(json.loads(message.data)))
            assert not any(value in (None, [], {}) for value in values), channel.topic
            assert len(values) <= 500
            assert all(abs(value) <= 1 << 53 for value in values if isinstance(value, int))


def test_times_are_mapped_to_the_wall_clock_by_one_offset(tmp_path: Path) -> None:
    with runs.write(tmp_path, [item(7)]).open("rb") as file:
        ((_, channel, message),) = make_reader(file).iter_messages()
    assert (channel.topic, message.sequence) == (STATE_KEY, 7)
    assert message.log_time == OFFSET_NS + 7_000_500
    assert message.publish_time == OFFSET_NS + 7_000_000


def test_with_a_wall_clock_behind_the_monotonic_clock_every_message_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A host without a battery for its clock begins in 1970."""
    monkeypatch.setattr(runs, "OFFSET_NS", -60 * 10**9)
    path = runs.write(tmp_path, [item(7), item(8)])
    with path.open("rb") as file:
        times = [message.publish_time for _, _, message in make_reader(file).iter_messages()]
    assert times == [7_000_000, 8_000_000]
    assert read_run(path).messages(topics.JOINT_STATE, "knee_right") == [
        runs.state(7), runs.state(8)
    ]  # fmt: skip


def test_an_existing_file_is_left_alone_and_the_next_number_is_taken(tmp_path: Path) -> None:
    (tmp_path / "run-1_3.mcap").write_bytes(b"all that is left of an older run")
    (tmp_path / "run-2.recovered.mcap").write_bytes(b"")
    first = runs.write(tmp_path, [item(0)])
    before = first.read_bytes()
    names = [runs.write(tmp_path, [item(seq)]).name for seq in (1, 2)]
    assert (first.name, *names) == ("run.mcap", "run-3.mcap", "run-4.mcap")
    assert first.read_bytes() == before


def test_foreign_keys_and_malformed_payloads_are_counted_and_not_written(tmp_path: Path) -> None:
    bad = [b"", b"{", b"\xff", b"{}", b'{"t_ns":-1,"seq":0}', b'{"t_ns":1,"seq":1e99}']
    with runs.writer(tmp_path) as run:
        foreign = ("xrl/lab/nobody", codec.encode(runs.state(0)), 1)
        run.take_from(Queue([foreign, *((STATE_KEY, p, 1) for p in bad), item(0)]), 100)
        assert run.messages == 1
        assert run.unknown == {"xrl/lab/nobody": 1}
        assert run.malformed == {STATE_KEY: len(bad)}


def test_a_full_disk_is_one_run_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = Path("/dev/full")
    opened = []

    def create(_directory: Path, _stem: str, _number: int) -> tuple[Path, object]:
        opened.append(full.open("wb"))
        return full, opened[-1]

    monkeypatch.setattr(files, "create", create)
    with pytest.raises(RunError, match=r"^/dev/full: cannot be written: No space left"):
        runs.writer(tmp_path)
    assert opened[0].closed


def test_a_split_run_is_one_file_after_the_other_and_each_stands_for_itself(tmp_path: Path) -> None:
    items = [item(seq) for seq in range(30)]
    paths = runs.write_in_parts(runs.writer(tmp_path), items)
    assert [path.name for path in paths] == ["run.mcap", "run_1.mcap", "run_2.mcap"]
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    assert [by_the_package(path) for path in paths] == [
        list(range(first, first + 10)) for first in (0, 10, 20)
    ]
    logs = [read_run(path) for path in paths]
    assert all(log.complete and log.attachments == ATTACHMENTS for log in logs)
    assert len({log.metadata["split"]["run"] for log in logs}) == 1
    assert [log.metadata["split"]["number"] for log in logs] == ["0", "1", "2"]
    assert all(log.metadata["split"]["first"] == "run.mcap" for log in logs)
    assert logs[1].metadata["split"]["why"] == "size"
    assert all(log.metadata["run"]["robot"] == runs.ROBOT for log in logs)


def test_what_is_lost_between_two_files_is_counted_in_the_second(tmp_path: Path) -> None:
    with runs.writer(tmp_path) as run:
        run.take_from(Queue([item(0), item(1)]), 10)
        run.finish()
        run.begin()
        run.take_from(Queue([item(5)]), 10)
        assert run.counts[STATE_KEY].count == 3
    counts = [
        json.loads(read_run(tmp_path / name).metadata["counts"][STATE_KEY])
        for name in ("run.mcap", "run_1.mcap")
    ]
    assert [c["count"] for c in counts] == [2, 1]
    assert [c["missing"] for c in counts] == [0, 3]


def test_a_file_is_locked_while_it_is_written_and_no_more_is_taken_than_asked_for(
    tmp_path: Path,
) -> None:
    source = Queue(item(seq) for seq in range(10))
    with runs.writer(tmp_path) as run:
        assert files.in_use(run.path)
        assert run.take_from(source, 4) == 4
        assert len(source.items) == 6
    assert not files.in_use(run.path)


def test_a_sync_that_fails_is_one_run_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("shared.mcap_log.files.os.fsync", fail)
    with pytest.raises(RunError, match=r"run\.mcap: cannot be .*Input/output error"):
        runs.write(tmp_path, [item(0)])
