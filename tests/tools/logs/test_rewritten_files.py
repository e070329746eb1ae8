"""A run's file that another program has written again is the same run to every reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from shared.bus import topics
from shared.mcap_log import recover
from shared.mcap_log.writer import COUNTS
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import ATTACHMENTS, STATE_KEY, item
from tools import cli
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, RunPart, read_run
from tools.logs.survey import Survey

COUNT = 3000
WRENCH_KEY = topics.WRENCH.key(runs.ROBOT)

NO_SUMMARY: dict[str, Any] = {
    "use_statistics": False,
    "use_summary_offsets": False,
    "repeat_channels": False,
    "repeat_schemas": False,
}
WAYS: dict[str, dict[str, Any]] = {
    "without_chunks": {"use_chunking": False},
    "without_chunks_and_summary": {"use_chunking": False, "index_types": IndexType.NONE}
    | NO_SUMMARY,
    "large_chunks_of_lz4": {"compression": CompressionType.LZ4, "chunk_size": 1 << 30},
    "small_chunks_of_lz4": {"compression": CompressionType.LZ4, "chunk_size": 2000},
    "chunks_uncompressed": {"compression": CompressionType.NONE, "chunk_size": 100_000},
    "without_index": {"index_types": IndexType.NONE},
    "without_index_and_summary": {"index_types": IndexType.NONE, "chunk_size": 9000} | NO_SUMMARY,
    "without_summary": {"index_types": IndexType.MESSAGE, "chunk_size": 9000} | NO_SUMMARY,
}


@pytest.fixture(autouse=True)
def no_wait_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.fsync", lambda _descriptor: None)


def late_key(seq: int) -> str:
    """Return a key: the wrench comes in the second half only, so its channel stands there."""
    return WRENCH_KEY if seq > COUNT // 2 and seq % 3 == 0 else STATE_KEY


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = (item(seq, late_key(seq)) for seq in range(COUNT))
    return runs.write(tmp_path_factory.mktemp("recorded"), rows)


def rewrite(
    source: Path, out: Path, *, keep: Callable[[Any], bool] = lambda _m: True, **how: Any
) -> Path:
    """Write a file again as other tools do: channels where their first message is."""
    with source.open("rb") as file, out.open("wb") as target:
        reader, writer = make_reader(file), Writer(target, **how)
        writer.start(profile=reader.get_header().profile, library="another")
        for one in reader.iter_attachments():
            writer.add_attachment(one.log_time, one.create_time, one.name, one.media_type, one.data)
        for about in reader.iter_metadata():
            writer.add_metadata(about.name, about.metadata)
        known: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if not keep(message):
                continue
            if channel.id not in known:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            writer.add_message(
                known[channel.id], message.log_time, message.data, message.publish_time,
                message.sequence,
            )  # fmt: skip
        writer.finish()  # type: ignore[no-untyped-call]
    return out


def raw_of(log: RunLog) -> dict[str, list[tuple[int, bytes, int]]]:
    return {key: log.raw(key) for key in (STATE_KEY, WRENCH_KEY)}


@pytest.mark.parametrize("way", WAYS)
def test_every_reader_finds_the_same_however_the_file_is_written(
    tmp_path: Path, recorded: Path, way: str
) -> None:
    path = rewrite(recorded, tmp_path / "run.mcap", **WAYS[way])
    again, first = read_run(path), read_run(recorded)
    assert raw_of(again) == raw_of(first)
    assert sum(len(rows) for rows in raw_of(again).values()) == COUNT
    assert again.attachments == ATTACHMENTS
    part = RunPart(2.0, 2.2)  # its channels are defined in another chunk
    assert raw_of(RunLog(RunIndex(path), part)) == raw_of(RunLog(RunIndex(recorded), part))
    assert (again.complete, again.damage, again.cut) == (True, [], None)
    assert RunIndex(path).keys_with_messages() == {STATE_KEY, WRENCH_KEY}
    for by_index in (False, True):
        survey = Survey()
        survey.add(path, by_index=by_index)
        assert survey.messages == COUNT
        assert not survey.files[0].damage
        assert not survey.topics[STATE_KEY].sequence.several, "the losses of our logs are known"


@pytest.mark.parametrize("way", WAYS)
def test_the_index_that_a_file_lacks_is_made_by_recover(
    tmp_path: Path, recorded: Path, way: str
) -> None:
    path = rewrite(recorded, tmp_path / "run.mcap", **WAYS[way])
    lacks = way.startswith("without")
    assert recover.is_whole(path) != lacks
    assert cli.main(["log", "recover", str(path)]) == 0
    copy = tmp_path / "run.recovered.mcap"
    assert copy.exists() == lacks
    if lacks:
        assert raw_of(read_run(copy)) == raw_of(read_run(recorded))


def test_the_recorders_counts_of_a_filtered_file_are_not_believed(
    tmp_path: Path, recorded: Path
) -> None:
    path = rewrite(recorded, tmp_path / "run.mcap", keep=lambda m: m.sequence % 2 == 0)
    survey = Survey()
    facts = survey.add(path, by_index=True)
    assert facts.metadata[COUNTS]
    assert survey.messages == COUNT // 2
