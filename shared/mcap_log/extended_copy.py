"""A copy of a log with further messages in it, such as a 3-D scene for viewers.

Recorded chunks are copied as they are. The new messages stand in chunks of their own between them,
so that a viewer finds what belongs together close by.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Metadata, Schema

from shared.atomic_file import atomic_file
from shared.exceptions import RunError
from shared.mcap_log.reader import LogReader, LogRecord, open_log
from shared.mcap_log.records import MESSAGE_RECORD, PREFIX, ChunkMessage, encode
from shared.mcap_log.recovered_copy import LogCopy

NOTE: Final = "export"
"""Metadata of the copy: where it comes from."""

_FIRST_ID: Final = 60_000  # of new schemas and channels: far beyond those of a recorder


class NewChannel(NamedTuple):
    """A channel to add; its encodings are named as in MCAP's registry."""

    topic: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    encoding: str
    """Encoding of the messages."""
    about: dict[str, str]


class NewMessage(NamedTuple):
    """A message to add."""

    channel: int
    """Index in the list of channels."""
    log_ns: int
    """Log time: ns since 1970, as in the recorded messages."""
    payload: bytes


def write_extended(
    path: Path, out: Path, channels: list[NewChannel], messages: Iterable[NewMessage]
) -> int:
    """Write a copy of a log with messages added.

    Args:
        path: the log; not touched.
        out: the file to write, finished; one of that name is replaced when it is complete.
        channels: with topics that the log does not have.
        messages: in the order of time.

    Returns:
        The number of messages in the copy.

    Raises:
        RunError: the log cannot be read or has such a topic, or the copy cannot be written.
    """
    try:
        with open_log(path) as reader, atomic_file(out, lasting=True) as file:
            copy = _copied(path, reader, file, channels, messages)
            copy.finish(Metadata(name=NOTE, metadata={"from": path.name}))
    except OSError as error:
        raise RunError(
            f"{out}: cannot be written: {error.strerror or error}; give another -o"
        ) from None
    return copy.messages


class _Additions:
    """The new channels and messages, written into a copy."""

    def __init__(self, copy: LogCopy, channels: list[NewChannel]) -> None:
        self._copy, self._channels = copy, channels
        self._sent = [0] * len(channels)

    def define(self) -> None:
        """Give the new channels their schemas and ids."""
        for number, row in enumerate(self._channels, _FIRST_ID):
            schema = Schema(
                id=number, data=row.schema, encoding=row.schema_encoding, name=row.schema_name
            )
            channel = Channel(
                id=number, topic=row.topic, message_encoding=row.encoding, metadata=row.about,
                schema_id=number,
            )  # fmt: skip
            self._copy.define(_as_read(Opcode.SCHEMA, schema))
            self._copy.define(_as_read(Opcode.CHANNEL, channel))

    def add(self, message: NewMessage) -> None:
        """Add a message."""
        number = _FIRST_ID + message.channel
        seq = self._sent[message.channel]
        self._sent[message.channel] += 1
        start = MESSAGE_RECORD.size
        head = (number, seq, message.log_ns, message.log_ns)
        length = start - PREFIX.size + len(message.payload)
        body = MESSAGE_RECORD.pack(Opcode.MESSAGE, length, *head) + message.payload
        row = ChunkMessage(*head, start, len(body))
        self._copy.take(LogRecord(Opcode.MESSAGE, 0, 0, body, rows=(row,)))


def _copied(
    path: Path,
    reader: LogReader,
    file: BinaryIO,
    channels: list[NewChannel],
    messages: Iterable[NewMessage],
) -> LogCopy:
    copy = LogCopy(file, reader.raw, "xrl export")
    additions = _Additions(copy, channels)
    topics = {channel.topic for channel in channels}
    waiting: Iterator[NewMessage] = iter(messages)
    following = next(waiting, None)
    defined = False
    for record in reader:
        if record.rows and not defined:
            defined = True
            additions.define()
        for value in record.values():
            if isinstance(value, Channel) and value.topic in topics:
                raise RunError(f"{path}: has {value.topic} already; export the original")
        copy.take(record)
        if record.rows:
            last_ns = max(row.log_ns for row in record.rows)
            while following is not None and following.log_ns <= last_ns:
                additions.add(following)
                following = next(waiting, None)
    if not defined:
        additions.define()
    while following is not None:
        additions.add(following)
        following = next(waiting, None)
    return copy


def _as_read(opcode: int, value: McapRecord) -> LogRecord:
    return LogRecord(opcode, 0, 0, encode(value)[PREFIX.size :], value)
