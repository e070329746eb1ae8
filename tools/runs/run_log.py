"""Reads a run's MCAP file, finished or killed.

A killed file has no summary, and may end in the middle of a record; the readers of
the mcap package find nothing in the first and may stumble over the second (design
section 10). This one walks the records from the start and keeps every whole one.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from services.recorder.gaps import KeyCount
from shared.exceptions import RunError
from shared.topics import Topic

_RECORD: Final = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_DAMAGED: Final = (struct.error, ValueError, McapError, ZstdError)


class Series:
    """The messages of one key, in the order in which they were recorded."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.received_ns: list[int] = []
        """Reception by the recorder, monotonic clock (once the offset is taken off)."""
        self.seq: list[int] = []
        self.decoded: list[Any] | None = None


class RunLog:
    """A run, in memory: about 2.5 MB for each second of the whole fleet.

    Messages are decoded when they are asked for, once for each key.
    """

    def __init__(self, path: Path) -> None:
        """Read a file; `read_run` is the name to use.

        Raises:
            RunError: the file is missing, empty, no MCAP file or no run.
        """
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        """Metadata records by name: `run`, `clock`, `packages`, at the end `counts`."""
        self.attachments: dict[str, bytes] = {}
        self.complete = False
        """True if the recorder finished the file; False if it was killed."""
        self.damaged = 0
        """Whole records that could not be read: their contents are left out."""
        self._series: dict[str, Series] = {}
        self._by_channel: dict[int, Series] = {}
        try:
            with path.open("rb") as file:
                self._read(file)
        except OSError as error:
            raise RunError(f"{path}: cannot be read: {error.strerror}; give an MCAP file") from None
        self.robot = self._required("run", "robot")
        offset = self._required("clock", "offset_ns")
        if not offset.lstrip("-").isdecimal():
            raise RunError(f"{path}: clock.offset_ns is {offset!r}; an integer is right")
        self.offset_ns = int(offset)
        """wall clock in ns since 1970 = `t_ns` of a message + `offset_ns`."""
        for series in self._series.values():
            series.received_ns = [t - self.offset_ns for t in series.received_ns]

    def keys(self) -> list[str]:
        """Return every key that has at least one message."""
        return [key for key, series in self._series.items() if series.payloads]

    def count(self, key: str) -> int:
        """Return the number of messages on a key; 0 for a key that is not in the file."""
        return len(self._of(key).payloads)

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        """Return the messages of a topic as `topic.type`, in the order of the file.

        Args:
            topic: a row of `shared.topics`.
            module: for a topic with one key for each module.

        Raises:
            RunError: a message is not of that type: another version wrote the file;
                or a module is needed and missing, or the other way round.
        """
        key = self._key(topic, module)
        series = self._of(key)
        if series.decoded is None:
            decode = msgspec.json.Decoder(topic.type).decode
            try:
                series.decoded = [decode(payload) for payload in series.payloads]
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                version = self.metadata["run"].get("schema_version", "unknown")
                raise RunError(
                    f"{self.path}: {key}: a message is no {topic.type.__name__}: {error}; "
                    f"the file has schema version {version}: read it with the code that wrote it"
                ) from None
        return series.decoded

    def received_ns(self, topic: Topic, module: str = "") -> list[int]:
        """Return when each of `messages(topic, module)` reached the recorder.

        Monotonic clock of the recorder's host: comparable with `t_ns` of senders there.
        """
        return self._of(self._key(topic, module)).received_ns

    def gaps(self) -> dict[str, KeyCount]:
        """Return counts, gaps and restarts of every key with messages, from the file itself."""
        found = {}
        for key in self.keys():
            found[key] = KeyCount()
            for seq in self._of(key).seq:
                found[key].feed(seq)
        return found

    def _key(self, topic: Topic, module: str) -> str:
        if topic.per_module != bool(module):
            right = "name a module" if topic.per_module else "name none"
            raise RunError(f"{topic.name}: module {module!r} does not fit this topic; {right}")
        return topic.key(self.robot, module)

    def _of(self, key: str) -> Series:
        return self._series.get(key) or Series()

    def _required(self, record: str, field: str) -> str:
        value = self.metadata.get(record, {}).get(field)
        if value is None:
            raise RunError(
                f"{self.path}: no metadata {record}.{field}; an MCAP file written by "
                "services.recorder, not cut off before its first message, is right"
            )
        return value

    def _read(self, file: BinaryIO) -> None:
        magic = file.read(len(MCAP0_MAGIC))
        if not magic:
            raise RunError(f"{self.path}: is empty; an MCAP file is right")
        if magic != MCAP0_MAGIC:
            raise RunError(f"{self.path}: is no MCAP file (wrong first bytes)")
        for opcode, body in _whole_records(file):
            try:
                self._take(opcode, body)
            except _DAMAGED:
                self.damaged += 1

    def _take(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(_stream(body))
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            self._take_chunk(stream.read(length))
        elif opcode == Opcode.METADATA:
            record = Metadata.read(_stream(body))
            self.metadata[record.name] = record.metadata
        elif opcode == Opcode.ATTACHMENT:
            attachment = Attachment.read(_stream(body))
            self.attachments[attachment.name] = attachment.data
        elif opcode == Opcode.CHANNEL:
            self._take_channel(body)
        elif opcode == Opcode.FOOTER:
            self.complete = True

    def _take_chunk(self, data: bytes) -> None:
        """Sort a chunk's messages by channel; the hot loop of reading."""
        position, end = 0, len(data)
        header, message_header = _RECORD.size, _MESSAGE.size
        while position < end:
            opcode, length = _RECORD.unpack_from(data, position)
            start = position + header
            position = start + length
            if opcode == Opcode.MESSAGE:
                channel, seq, log_time, _ = _MESSAGE.unpack_from(data, start)
                series = self._by_channel[channel]
                series.payloads.append(data[start + message_header : position])
                series.received_ns.append(log_time)
                series.seq.append(seq)
            elif opcode == Opcode.CHANNEL:
                self._take_channel(data[start:position])

    def _take_channel(self, body: bytes) -> None:
        channel = Channel.read(_stream(body))
        self._by_channel[channel.id] = self._series.setdefault(channel.topic, Series())


def read_run(path: Path) -> RunLog:
    """Read a run's file, finished or killed.

    Raises:
        RunError: the file is missing, empty, no MCAP file or no run.
    """
    return RunLog(path)


def _whole_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, content) of each record; end silently where the file was cut."""
    size = Path(file.name).stat().st_size
    while len(header := file.read(_RECORD.size)) == _RECORD.size:
        opcode, length = _RECORD.unpack(header)
        # 0 is no opcode: a power cut can leave zeros where the data never got to.
        if opcode == 0 or length > size - file.tell():
            return
        yield opcode, file.read(length)


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))
