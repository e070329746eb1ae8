"""Write a run's MCAP files.

A run is `run.mcap`, and `run_1.mcap`, `run_2.mcap`, ... if it is split; each can be read alone.
Layout of each: metadata `run`, `clock`, `packages` and `split`, the attachments, all schemas and
channels, then zstd chunks with the messages as received (JSON), key by key within a chunk, at the
end metadata `counts` (of this file) and the summary. The mcap package writes schemas and channels
again in the first chunk: if one copy is damaged, the other remains.

Time: `log_time` is the time at which the recorder read a message from its queue (at most one drain
period after its arrival), rounded up to a millisecond; `publish_time` is the message's own `t_ns`.
Both come from monotonic clocks. One offset, measured at the start and written as `offset_ns` into
metadata `clock`, maps them to ns since 1970 so that viewers show dates: wall = monotonic +
offset_ns. It is the recorder's offset, so `publish_time` is meaningful only for senders on the
recorder's host.

A file whose writer was killed has no summary: `shared/mcap_log/recover.py` adds one, and
`tools/logs/run_log.py` can read the file without it. A file is locked while it is written.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import secrets
from collections.abc import Iterator, Mapping
from enum import Enum
from operator import itemgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, BinaryIO, Final, Protocol

import mcap.writer
import msgspec
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer

from shared.bus.topics import Topic, several_may_write
from shared.exceptions import RunError
from shared.mcap_log import files, schema
from shared.mcap_log.records import MESSAGE_RECORD, ZSTD_LEVEL
from shared.mcap_log.sequence_stats import KeyCount

SCHEMA_VERSION: Final = "9"
"""Version of the layout above and of the messages in `shared/bus/messages.py`."""

# mcap's writer has no option for the level
mcap.writer.zstandard = SimpleNamespace(  # type: ignore[assignment, attr-defined]
    compress=functools.partial(zstandard.compress, level=ZSTD_LEVEL)
)

PROFILE: Final = "xrl"
COUNTS: Final = "counts"
"""Metadata at the end of a file: counts, gaps and restarts of each key in it."""

_MEDIA_TYPES: Final = {
    ".json": "application/json",
    ".toml": "application/toml",
    ".txt": "text/plain",
    ".urdf": "application/xml",
    ".xml": "application/xml",
}
_SEQUENCE_MASK: Final = 0xFFFFFFFF  # MCAP stores 32 bits; the payload has all of them
_UNSIGNED = msgspec.Meta(ge=0, le=2**62)  # so that MCAP's unsigned 64-bit times can hold it


class MessageSource(Protocol):
    """Source of messages: a stream of the bus."""

    def take(self) -> tuple[str, bytes, int] | None:
        """Return (key, payload, monotonic ns of this call), or None if no message is waiting."""


class FilePlace(Enum):
    """Location of the file that is being written."""

    THERE = "at its path"
    MOVED = "moved away"
    REMOVED = "removed"


class _MessageHead(msgspec.Struct, gc=False):
    """The two fields of a message that the recorder needs; the rest is skipped."""

    t_ns: Annotated[int, _UNSIGNED]
    seq: Annotated[int, _UNSIGNED]


class _GroupedWriter(Writer):
    """The mcap package's writer, with the messages of each chunk grouped by key.

    Alike messages compress better side by side: a log is 4 % shorter.
    """

    def __init__(self, file: BinaryIO, chunk_size: int) -> None:
        super().__init__(file, chunk_size=1 << 62, compression=CompressionType.ZSTD)
        self._rows: list[tuple[int, int, bytes, int, int]] = []
        self._size, self._chunk_size = 0, chunk_size

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Add a message to the next chunk; write the chunk if it is full."""
        self._rows.append((channel_id, log_time, data, publish_time, sequence))
        self._size += MESSAGE_RECORD.size + len(data)
        if self._size >= self._chunk_size:
            self.flush()

    def flush(self) -> None:
        """Write the next chunk, if it has messages, and flush the file."""
        self._rows.sort(key=itemgetter(0))
        for row in self._rows:
            super().add_message(*row)
        self._rows.clear()
        self._size = 0
        super().flush()  # type: ignore[no-untyped-call]  # mcap's


class RunWriter:
    """One run being written; leaving the `with` block finishes its file.

    If an exception leaves the block, the file is closed as it is: readable, but without a summary.
    """

    def __init__(
        self,
        directory: Path,
        topics: Mapping[str, Topic],
        *,
        offset_ns: int,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Mapping[str, bytes],
        chunk_kib: int,
        begin: bool = True,
    ) -> None:
        """Create `run.mcap` in `directory`, or `run-1.mcap`, ... if a run is there already.

        `topics` has the topic of every key to record; `offset_ns` is wall minus monotonic clock. A
        negative offset means that the wall clock is not set. The file's times are then monotonic,
        because MCAP has no time before 1970. `metadata` records, by name, and `attachments`, by
        file name, are written to each file; `chunk_kib` is the size of a chunk before compression.
        If `begin` is False, the first file is created by calling the method `begin`. Raises
        RunError if the file cannot be created or written, as all methods do.
        """
        self.path = directory / files.FIRST
        """The file being written, or the last one."""
        self.begun = 0
        """Files started so far."""
        self.counts: dict[str, KeyCount] = {
            key: KeyCount(several=several_may_write(key)) for key in topics
        }
        """Counts of the whole run."""
        self.unknown: dict[str, int] = {}
        """Messages on keys outside the table of topics; not written."""
        self.malformed: dict[str, int] = {}
        """Messages without a readable `t_ns` and `seq`; not written."""
        self.left_out = 0
        """Messages that arrived while no file could be written."""
        self._directory, self._topics = directory, topics
        self._offset_ns, self._chunk_size = max(0, offset_ns), chunk_kib * 1024
        self._metadata, self._attachments = metadata, attachments
        self._run_id = secrets.token_hex(8)
        self._stem = ""
        self._channels: dict[str, tuple[int, KeyCount]] = {}
        self._before: dict[str, KeyCount] = {}
        """Counts at the start of the file."""
        self._decode = msgspec.json.Decoder(_MessageHead).decode
        self._file: BinaryIO | None = None
        self._syncer = files.FsyncThread()
        if begin:
            self.begin()

    def __enter__(self) -> RunWriter:
        """Return the writer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        """Finish the file; after an error only close it."""
        try:
            if kind is None:
                self.finish()
                with self._as_run_error("cannot be written"):
                    self._syncer.settle()
        finally:
            self._close_as_it_is()
            self._syncer.close()

    @property
    def messages(self) -> int:
        """Messages written so far, in all files."""
        return sum(count.count for count in self.counts.values())

    @property
    def recording(self) -> bool:
        """True if a file is open."""
        return self._file is not None

    @property
    def size(self) -> int:
        """Bytes of the open file up to its last whole chunk; 0 if none is open."""
        return self._file.tell() if self._file is not None else 0

    @property
    def messages_in_file(self) -> int:
        """Messages written to the newest file so far."""
        return self.messages - sum(count.count for count in self._before.values())

    @property
    def where_is_file(self) -> FilePlace:
        """Location of the open file: at its path, moved away or removed."""
        if self._file is None:
            return FilePlace.THERE
        own = os.fstat(self._file.fileno())
        try:
            there = os.path.samestat(own, self.path.stat())
        except (FileNotFoundError, NotADirectoryError):
            there = False
        except OSError:  # unknown
            there = True
        if there:
            return FilePlace.THERE
        return FilePlace.MOVED if own.st_nlink else FilePlace.REMOVED

    def begin(self, note: Mapping[str, str] | None = None) -> None:
        """Start the run's next file, with metadata and attachments; `note` is added to `split`."""
        with self._as_run_error("cannot be created"):
            self._directory.mkdir(parents=True, exist_ok=True)
            self._stem = self._stem or files.free_stem(self._directory)
            self.path, self._file = files.create(self._directory, self._stem, self.begun)
        self._writer = _GroupedWriter(self._file, self._chunk_size)
        try:
            with self._as_run_error("cannot be written"):
                self._start(self._file, note or {})
        except RunError:
            self._close_as_it_is()
            raise
        self.begun += 1
        self._before = copy.deepcopy(self.counts)

    def take_from(self, source: MessageSource, at_most: int) -> int:
        """Write messages until the source is empty or `at_most` are read; return the number read.

        While no file is open, messages are not written, only counted as left out.
        """
        if self._file is None:
            return self._leave_out(source, at_most)
        taken = 0
        channels, decode, offset_ns = self._channels, self._decode, self._offset_ns
        add_message = self._writer.add_message
        with self._as_run_error("cannot be written"):
            while taken < at_most and (item := source.take()) is not None:
                taken += 1
                key, payload, received_ns = item
                channel = channels.get(key)
                if channel is None:
                    self.unknown[key] = self.unknown.get(key, 0) + 1
                    continue
                try:
                    head = decode(payload)
                except (msgspec.DecodeError, UnicodeDecodeError):
                    self.malformed[key] = self.malformed.get(key, 0) + 1
                    continue
                channel_id, count = channel
                count.feed(head.seq)
                add_message(
                    channel_id,
                    received_ns + offset_ns,
                    payload,
                    head.t_ns + offset_ns,
                    head.seq & _SEQUENCE_MASK,
                )
        return taken

    def flush(self) -> None:
        """Pass all data to the kernel, so that it survives if this process is killed."""
        if self._file is not None:
            with self._as_run_error("cannot be written"):
                self._writer.flush()

    def sync(self) -> None:
        """Flush, and sync to the disk in the background, so that all data survives a power cut."""
        if self._file is not None:
            with self._as_run_error("cannot be written"):
                self._writer.flush()
                self._syncer.request(self._file.fileno())

    def finish(self) -> None:
        """Finish the open file, if any; `begin` starts the next."""
        if self._file is None:
            return
        with self._as_run_error("cannot be finished"):
            self._writer.flush()  # the counts follow the last messages
            counts = {
                key: msgspec.json.encode(_since(self._before[key], count)).decode()
                for key, count in self.counts.items()
            }
            self._writer.add_metadata(COUNTS, counts)
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap's
            self._file.flush()  # finish() does not flush a stream that was passed in
            self._syncer.request(self._file.fileno(), last=True)
        self._close_as_it_is()

    def _start(self, file: BinaryIO, note: Mapping[str, str]) -> None:
        self._writer.start(profile=PROFILE)
        clock = {"offset_ns": str(self._offset_ns), "rule": "wall_ns = monotonic_ns + offset_ns"}
        split = {"run": self._run_id, "number": str(self.begun), "first": self._stem + ".mcap"}
        records = {**self._metadata, "clock": clock, "split": split | dict(note)}
        for name, entries in records.items():
            self._writer.add_metadata(name, dict(entries))
        for name, content in self._attachments.items():
            media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
            self._writer.add_attachment(0, 0, name, media_type, content)
        self._register(file)
        self._writer.flush()
        file.flush()
        self._syncer.request(file.fileno())

    def _register(self, file: BinaryIO) -> None:
        """Write a channel for every key now; the mcap writer does so only in the first chunk."""
        early = RecordBuilder()
        schemas: dict[str, int] = {}
        for key, topic in self._topics.items():
            name = schema.name_of(topic.type)
            if name not in schemas:
                content = schema.encoded(topic.type)
                schemas[name] = self._writer.register_schema(name, schema.ENCODING, content)
                Schema(schemas[name], content, schema.ENCODING, name).write(early)
            about = {"rate_hz": f"{topic.rate_hz:g}", "why": topic.why}
            encoding = MessageEncoding.JSON
            channel_id = self._writer.register_channel(key, encoding, schemas[name], about)
            Channel(channel_id, key, encoding, about, schemas[name]).write(early)
            self._channels[key] = (channel_id, self.counts[key])
        file.write(early.end())  # type: ignore[no-untyped-call]  # mcap's

    def _leave_out(self, source: MessageSource, at_most: int) -> int:
        taken = 0
        while taken < at_most and source.take() is not None:
            taken += 1
        self.left_out += taken
        return taken

    def _close_as_it_is(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # a failed write was reported already
                self._file.close()
            self._file = None

    @contextlib.contextmanager
    def _as_run_error(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RunError(
                f"{self.path}: {what}: {error.strerror or error}; the data flushed so far "
                "stays readable; free some space, or record elsewhere with --out"
            ) from None


def _since(before: KeyCount, now: KeyCount) -> KeyCount:
    return KeyCount(
        count=now.count - before.count,
        gaps=now.gaps - before.gaps,
        missing=now.missing - before.missing,
        restarts=now.restarts - before.restarts,
        last_seq=now.last_seq,
        several=now.several,
    )
