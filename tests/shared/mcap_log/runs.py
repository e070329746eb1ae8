"""Runs for the tests: sample messages, a source in memory, files written from it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mcap.reader import SeekingReader, make_reader
from mcap.stream_reader import StreamReader

from shared.bus import codec, topics
from shared.bus.messages import JointState
from shared.bus.topics import Topic
from shared.mcap_log.writer import SCHEMA_VERSION, RunWriter
from tests.messages import sample
from tools.logs.run_log import RunLog

ROBOT = "lab"
OFFSET_NS = 1_700_000_000_000_000_000
METADATA = {"run": {"robot": ROBOT, "schema_version": SCHEMA_VERSION}, "packages": {"xrl": "0"}}
ATTACHMENTS = {"robot.toml": b'name = "lab"\n', "model.xml": b"<mujoco/>"}
FROM_RECORDER = ("clock", "split", "counts")
"""Metadata written by the recorder itself."""
STATE_KEY = topics.JOINT_STATE.key(ROBOT, "knee_right")


class Queue:
    """A source that gives what it was given."""

    def __init__(self, items: Iterable[tuple[str, bytes, int]] = ()) -> None:
        self.items = deque(items)
        self.misdelivered = 0

    def take(self) -> tuple[str, bytes, int] | None:
        return self.items.popleft() if self.items else None


def state(seq: int) -> JointState:
    found: JointState = sample(JointState, seq=seq, t_ns=1_000_000 * seq, q=(seq * 0.001, -0.37))
    return found


def item(seq: int, key: str = STATE_KEY) -> tuple[str, bytes, int]:
    return key, codec.encode(state(seq)), 1_000_000 * seq + 500


def writer(
    directory: Path,
    chunk_kib: int = 16,
    *,
    keys: Mapping[str, Topic] | None = None,
    begin: bool = True,
) -> RunWriter:
    return RunWriter(
        directory,
        topics.recorded_keys(ROBOT) if keys is None else keys,
        offset_ns=OFFSET_NS,
        metadata=METADATA,
        attachments=ATTACHMENTS,
        chunk_kib=chunk_kib,
        begin=begin,
    )


def writer_like(log: RunLog, directory: Path) -> RunWriter:
    """Return what writes another run with all that is said about a log."""
    return RunWriter(
        directory,
        topics.recorded_keys(log.robot),
        offset_ns=log.offset_ns,
        metadata={name: row for name, row in log.metadata.items() if name not in FROM_RECORDER},
        attachments=log.attachments,
        chunk_kib=64,
    )


def write_in_parts(
    run: RunWriter, rows: Sequence[tuple[str, bytes, int]], parts: int = 3
) -> list[Path]:
    """Write messages into several files, as many into each, and return their paths."""
    size, paths = -(-len(rows) // parts), []
    with run:
        for part in range(parts):
            if part:
                run.finish()
                run.begin({"why": "size"})
            run.take_from(Queue(rows[part * size : (part + 1) * size]), size)
            paths.append(run.path)
    return paths


def recorded_in_parts(whole: RunLog, folder: Path) -> Path:
    """Record the messages of a run once more, in three files; return their folder."""
    rows = sorted((t, key, data) for key in whole.keys() for t, data, _ in whole.raw(key))  # noqa: SIM118
    write_in_parts(writer_like(whole, folder), [(key, data, t) for t, key, data in rows])
    return folder


def write(directory: Path, items: Iterable[tuple[str, bytes, int]]) -> Path:
    """Write a finished file and return its path."""
    with writer(directory) as run:
        run.take_from(Queue(items), 1_000_000)
    return run.path


class Killed(NamedTuple):
    """A file as a kill leaves it."""

    path: Path
    flushed: list[tuple[int, int]]
    """(size of the file, messages in it) after each flush."""

    def at_least(self, size: int) -> int:
        """Return how many messages were flushed when the file had some size."""
        return max((count for flushed, count in self.flushed if flushed <= size), default=0)


def killed_file(
    directory: Path, batches: int = 12, size: int = 100, *, keys: Mapping[str, Topic] | None = None
) -> Killed:
    """Write messages in batches, each flushed, and keep the file as it is before its end."""
    path = directory / "killed.mcap"
    with writer(directory / "written", keys=keys) as run:
        flushed = [(run.path.stat().st_size, 0)]
        for batch in range(batches):
            run.take_from(Queue(item(batch * size + n) for n in range(size)), size)
            run.flush()
            flushed.append((run.path.stat().st_size, (batch + 1) * size))
        path.write_bytes(run.path.read_bytes())
    return Killed(path, flushed)


def few_topics() -> dict[str, Topic]:
    """Return a small table, for small files."""
    return {STATE_KEY: topics.JOINT_STATE, topics.WRENCH.key(ROBOT): topics.WRENCH}


def by_the_package(path: Path) -> list[int]:
    """Return the sequence numbers that the mcap package finds in a consistent file.

    Its CRCs are right, each chunk has its index, and the summary counts what is in the file and
    describes every channel.
    """
    with path.open("rb") as file:
        assert list(StreamReader(file, validate_crcs=True).records)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert isinstance(reader, SeekingReader)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = list(reader.iter_messages())
        assert summary.statistics.message_count == len(found)
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count
        assert summary.statistics.attachment_count == len(list(reader.iter_attachments()))
        assert summary.statistics.metadata_count == len(list(reader.iter_metadata()))
        assert {channel.id for _, channel, _ in found} <= set(summary.channels)
        times = [message.log_time for _, _, message in found]
        if times:
            span = summary.statistics.message_start_time, summary.statistics.message_end_time
            assert span == (min(times), max(times))
    return [message.sequence for _, _, message in found]
