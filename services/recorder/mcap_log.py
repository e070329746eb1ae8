"""The run's MCAP file: the one place of the services that writes this format.

Layout: metadata `run`, `clock` and `packages`, then the attachments, then zstd chunks
with the messages as they came (JSON), at the end metadata `counts` and the summary.

Time: `log_time` is when the recorder took a message off its queue (at most one drain
period after it came), `publish_time` the message's own `t_ns`. Both are monotonic
clocks; one offset, taken at the start and written as `offset_ns` into metadata `clock`,
maps them to ns since 1970 so that viewers show dates: wall = monotonic + offset_ns.
`publish_time` therefore means something only for senders on the recorder's host.

A file whose writer was killed has no summary: read it with `tools/runs/run_log.py`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Annotated, BinaryIO, Final, Protocol

import msgspec
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer

from services.recorder import schema
from services.recorder.gaps import KeyCount
from shared.exceptions import RunError
from shared.topics import Topic

SCHEMA_VERSION: Final = "1"
"""Of the layout above and of the messages in `shared/messages.py`."""

FILE_NAME: Final = "run.mcap"
PROFILE: Final = "xrl"

_MEDIA_TYPES: Final = {
    ".json": "application/json",
    ".toml": "application/toml",
    ".txt": "text/plain",
    ".urdf": "application/xml",
    ".xml": "application/xml",
}
_SEQUENCE_MASK: Final = 0xFFFFFFFF  # MCAP keeps 32 bits; the payload has all of them
_UNSIGNED = msgspec.Meta(ge=0, le=2**62)  # so that MCAP's unsigned 64-bit times can hold it


class Source(Protocol):
    """Where messages come from: a stream of the bus."""

    def take(self) -> tuple[str, bytes, int] | None:
        """Return (key, payload, monotonic ns of this call), or None if there is none now."""


class _Head(msgspec.Struct, gc=False):
    """The two fields of a message that the recorder needs; the rest is skipped over."""

    t_ns: Annotated[int, _UNSIGNED]
    seq: Annotated[int, _UNSIGNED]


class RunWriter:
    """One file being written; leaving the `with` block finishes it.

    If the block is left by an exception the file is closed as it is: a readable
    file without a summary.
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
    ) -> None:
        """Create `run.mcap` in `directory`, or `run-1.mcap`, ... if there is one already.

        Args:
            directory: made if absent.
            topics: topic of every key to record; each gets a channel.
            offset_ns: wall minus monotonic clock.
            metadata: records for the start of the file, by name.
            attachments: contents by file name.
            chunk_kib: size of a chunk before compression.

        Raises:
            RunError: the file cannot be created or written.
        """
        self.path = directory / FILE_NAME
        self.counts: dict[str, KeyCount] = {}
        self.unknown: dict[str, int] = {}
        """Messages on keys that have no row in the table of topics; not written."""
        self.malformed: dict[str, int] = {}
        """Messages without a readable `t_ns` and `seq`; not written."""
        self._offset_ns = offset_ns
        self._channels: dict[str, tuple[int, KeyCount]] = {}
        self._decode = msgspec.json.Decoder(_Head).decode
        with self._as_run_error("cannot be created"):
            directory.mkdir(parents=True, exist_ok=True)
            self.path, self._file = _create(directory)
        self._writer = Writer(
            self._file, chunk_size=chunk_kib * 1024, compression=CompressionType.ZSTD
        )
        # mcap leaves these two without annotations
        self._flush_writer: Callable[[], None] = self._writer.flush
        self._finish_writer: Callable[[], None] = self._writer.finish
        try:
            with self._as_run_error("cannot be written"):
                self._start(topics, metadata, attachments)
        except RunError:
            self._close_as_it_is()
            raise

    def __enter__(self) -> RunWriter:
        """Return the writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the file; after an error only close it.

        Raises:
            RunError: the end of the file cannot be written.
        """
        try:
            if kind is None:
                self._finish()
        finally:
            self._close_as_it_is()

    @property
    def messages(self) -> int:
        """Messages written so far."""
        return sum(count.count for count in self.counts.values())

    def take_from(self, source: Source, at_most: int) -> int:
        """Write what has come, until the source is empty; return the number taken.

        Raises:
            RunError: the file cannot be written.
        """
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
        """Hand everything to the kernel: it then survives a kill of this process.

        Raises:
            RunError: the file cannot be written.
        """
        with self._as_run_error("cannot be written"):
            self._flush_writer()

    def sync(self) -> None:
        """Flush, and wait for the disk: it then survives a loss of power.

        Raises:
            RunError: the file cannot be written.
        """
        with self._as_run_error("cannot be written"):
            self._flush_writer()
            os.fsync(self._file.fileno())

    def _start(
        self,
        topics: Mapping[str, Topic],
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Mapping[str, bytes],
    ) -> None:
        self._writer.start(profile=PROFILE)
        clock = {"offset_ns": str(self._offset_ns), "rule": "wall_ns = monotonic_ns + offset_ns"}
        for name, entries in {**metadata, "clock": clock}.items():
            self._writer.add_metadata(name, dict(entries))
        for name, content in attachments.items():
            media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
            self._writer.add_attachment(0, 0, name, media_type, content)
        schemas: dict[str, int] = {}
        for key, topic in topics.items():
            name = schema.name_of(topic.type)
            if name not in schemas:
                schemas[name] = self._writer.register_schema(
                    name, schema.ENCODING, schema.encoded(topic.type)
                )
            about = {"rate_hz": f"{topic.rate_hz:g}", "why": topic.why}
            channel_id = self._writer.register_channel(
                key, MessageEncoding.JSON, schemas[name], about
            )
            self.counts[key] = KeyCount()
            self._channels[key] = (channel_id, self.counts[key])
        self._flush_writer()
        os.fsync(self._file.fileno())

    def _finish(self) -> None:
        with self._as_run_error("cannot be finished"):
            self._flush_writer()  # the counts go behind the last messages
            counts = {
                key: msgspec.json.encode(count).decode() for key, count in self.counts.items()
            }
            self._writer.add_metadata("counts", counts)
            self._finish_writer()
            self._file.flush()  # finish() leaves the end of a stream that was passed in unwritten
            os.fsync(self._file.fileno())

    def _close_as_it_is(self) -> None:
        with contextlib.suppress(OSError):  # what could not be written was reported already
            self._file.close()

    @contextlib.contextmanager
    def _as_run_error(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RunError(
                f"{self.path}: {what}: {error.strerror or error}; what was flushed before "
                "stays readable; free space there, or record elsewhere with --out"
            ) from None


def _create(directory: Path) -> tuple[Path, BinaryIO]:
    """Create the first file of run.mcap, run-1.mcap, ... that does not exist yet."""
    stem, suffix = Path(FILE_NAME).stem, Path(FILE_NAME).suffix
    path, number = directory / FILE_NAME, 0
    while True:
        try:
            return path, path.open("xb")
        except FileExistsError:
            number += 1
            path = directory / f"{stem}-{number}{suffix}"
