"""A copy of a log with messages added, read back by the mcap package."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.summary import Summary

from shared.exceptions import RunError
from shared.mcap_log.log_copy import NOTE, NewChannel, NewMessage, write_extended
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import ATTACHMENTS, OFFSET_NS, STATE_KEY, item
from tools.logs.run_log import read_run

SCHEMA = b"\n\x00\xff of any kind"
CHANNEL = NewChannel("xrl/lab/scene/x", "x.Y", "protobuf", SCHEMA, "protobuf", {"why": "t"})


def added(*times_ns: int) -> list[NewMessage]:
    return [NewMessage(0, OFFSET_NS + t, b'{"n":%d}' % n) for n, t in enumerate(times_ns)]


def everything(path: Path) -> list[tuple[str, int, int, bytes]]:
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.sequence, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        ]


def summary_of(path: Path) -> Summary:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return summary


@pytest.fixture
def record(tmp_path: Path) -> Path:
    return runs.write(tmp_path, [item(seq) for seq in range(3000)])


def test_the_copy_holds_what_was_recorded_and_what_was_added_in_order(
    record: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    new = added(0, 1_400_000_250, 2_999_999_000, 9_000_000_000)
    assert write_extended(record, out, [CHANNEL], new) == 3004
    found = everything(out)
    assert [row for row in found if row[0] == STATE_KEY] == everything(record)
    mine = [row for row in found if row[0] == CHANNEL.topic]
    assert mine == [
        (CHANNEL.topic, row.log_ns, number, row.payload) for number, row in enumerate(new)
    ]
    assert [row[1] for row in found] == sorted(row[1] for row in found)


def test_the_copy_is_a_log_like_any_other(record: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    write_extended(record, out, [CHANNEL], added(5))
    log = read_run(out)
    assert (log.complete, log.damage, log.attachments) == (True, [], ATTACHMENTS)
    assert log.metadata[NOTE] == {"from": record.name}
    assert "recovered" not in log.metadata
    summary = summary_of(out)
    channel = next(c for c in summary.channels.values() if c.topic == CHANNEL.topic)
    schema = summary.schemas[channel.schema_id]
    assert (schema.name, schema.encoding, schema.data) == ("x.Y", "protobuf", SCHEMA)
    assert (channel.message_encoding, channel.metadata) == ("protobuf", {"why": "t"})


def test_what_was_added_stands_near_what_was_recorded_then(record: Path, tmp_path: Path) -> None:
    """A viewer reads by chunks: one that spans the whole run would be read all the time."""
    out = tmp_path / "out.mcap"
    write_extended(record, out, [CHANNEL], added(*range(0, 3_000_000_000, 10_000_000)))
    summary = summary_of(out)
    spans = [c.message_end_time - c.message_start_time for c in summary.chunk_indexes]
    assert len(spans) > 10
    assert max(spans) < 1e9


def test_an_unfinished_log_is_copied_and_finished(tmp_path: Path) -> None:
    killed = runs.killed_file(tmp_path)
    out = tmp_path / "out.mcap"
    write_extended(killed.path, out, [CHANNEL], added(0))
    assert len(everything(out)) == killed.flushed[-1][1] + 1


def test_a_topic_that_is_there_already_is_refused_and_nothing_is_written(
    record: Path, tmp_path: Path
) -> None:
    out, again = tmp_path / "out.mcap", tmp_path / "again.mcap"
    write_extended(record, out, [CHANNEL], added(0))
    with pytest.raises(RunError, match="has xrl/lab/scene/x already"):
        write_extended(out, again, [CHANNEL], added(0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.mcap", "run.mcap"]
    with pytest.raises(RunError, match="cannot be written"):
        write_extended(record, tmp_path / "absent" / "x.mcap", [CHANNEL], added(0))
