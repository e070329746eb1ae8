"""A copy of a log with further messages in it, such as a 3-D scene for viewers.

What was recorded is taken over chunk by chunk, as it is; the new messages stand in chunks
of their own between them, so that a viewer finds what belongs together close by.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from services.recorder import mcap_encoding as encoding
from services.recorder import mcap_records as mcap
from services.recorder.mcap_records import ChunkMessage, Malformed
from services.recorder.reader import Piece, Salvage, opened
from services.recorder.recovered_copy import Copy
from shared.exceptions import RunError

LIBRARY: Final = "xrl export"
NOTE: Final = "export"
"""Metadata of the copy: where it comes from."""

_HEAD: Final = struct.Struct("<HIQQ")  # of a message: channel, sequence, log and publish time
_FIRST_ID: Final = 60_000  # of new schemas and channels: far beyond those of a recorder


class NewChannel(NamedTuple):
    """A channel to add. Its encodings are named as MCAP's registry has them."""

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
    """Place in the list of channels."""
    log_ns: int
    """Log time: ns since 1970, as of the messages that were recorded."""
    payload: bytes


def extended(
    path: Path, out: Path, channels: list[NewChannel], messages: Iterable[NewMessage]
) -> int:
    """Write a copy of a log with messages added.

    Args:
        path: the log; not touched.
        out: the file to write, finished; one of that name is replaced when it is complete.
        channels: with topics that the log does not have.
        messages: in the order of time.

    Returns:
        How many messages the copy has.

    Raises:
        RunError: the log cannot be read or has such a topic, or the copy cannot be written.
    """
    part = out.with_name(f".{out.name}.part")
    try:
        with opened(path) as salvage, part.open("wb") as file:
            copy = _copied(path, salvage, file, channels, messages)
            copy.finish(path.name, 0)
            file.flush()
            os.fsync(file.fileno())
        part.replace(out)
    except OSError as error:
        _remove(part)
        raise RunError(
            f"{out}: cannot be written: {error.strerror or error}; give another -o"
        ) from None
    except BaseException:
        _remove(part)
        raise
    return copy.messages


class _Extended(Copy):
    """The copy that recovery makes, under its own name and with more in it."""

    def __init__(self, file: BinaryIO, salvage: Salvage, channels: list[NewChannel]) -> None:
        super().__init__(file, salvage.raw)
        self._new = channels
        self._sent = [0] * len(channels)
        self._ends = False

    def announce(self) -> None:
        """Give the new channels their schemas and numbers."""
        for number, row in enumerate(self._new, _FIRST_ID):
            head = struct.pack("<H", number) + _text(row.schema_name) + _text(row.schema_encoding)
            self.take(_piece(mcap.SCHEMA, head + struct.pack("<I", len(row.schema)) + row.schema))
            about = b"".join(_text(key) + _text(value) for key, value in row.about.items())
            body = struct.pack("<HH", number, number) + _text(row.topic) + _text(row.encoding)
            self.take(_piece(mcap.CHANNEL, body + struct.pack("<I", len(about)) + about))

    def add(self, message: NewMessage) -> None:
        """Take a new message."""
        number = _FIRST_ID + message.channel
        seq = self._sent[message.channel]
        self._sent[message.channel] += 1
        head = _HEAD.pack(number, seq, message.log_ns, message.log_ns)
        body = head + message.payload
        row = ChunkMessage(number, seq, message.log_ns, message.log_ns, _HEAD.size, len(body))
        self.take(_piece(mcap.MESSAGE, body, (row,)))

    def finish(self, source: str, lost_bytes: int) -> None:
        self._ends = True
        super().finish(source, lost_bytes)

    def _begin(self, profile: str) -> None:
        if not self._begun:
            self._begun = True
            self._write(mcap.MAGIC + encoding.header_record(profile, LIBRARY))

    def _write_metadata(self, body: bytes) -> None:
        if self._ends:  # what recovery notes at the end is not so here: nothing was lost
            _, entries = mcap.metadata(body)
            body = encoding.metadata_body(NOTE, {"from": entries["from"]})
        super()._write_metadata(body)


def _copied(
    path: Path,
    salvage: Salvage,
    file: BinaryIO,
    channels: list[NewChannel],
    messages: Iterable[NewMessage],
) -> _Extended:
    copy = _Extended(file, salvage, channels)
    topics = {channel.topic for channel in channels}
    waiting: Iterator[NewMessage] = iter(messages)
    following = next(waiting, None)
    announced = False
    for piece in salvage:
        if piece.rows and not announced:
            announced = True
            copy.announce()
        for topic in _topics_in(piece):
            if topic in topics:
                raise RunError(f"{path}: has {topic} already; export the original")
        copy.take(piece)
        if piece.chunk is not None:
            while following is not None and following.log_ns <= piece.chunk.last_ns:
                copy.add(following)
                following = next(waiting, None)
    if not announced:
        copy.announce()
    while following is not None:
        copy.add(following)
        following = next(waiting, None)
    return copy


def _topics_in(piece: Piece) -> Iterator[str]:
    """Yield the topics that a piece describes."""
    for opcode, body in ((piece.opcode, piece.body), *piece.others):
        if opcode == mcap.CHANNEL:
            with contextlib.suppress(Malformed):
                yield mcap.channel(body).topic


def _piece(opcode: int, body: bytes, rows: tuple[ChunkMessage, ...] = ()) -> Piece:
    return Piece(opcode, 0, 0, body, rows=rows)


def _text(value: str) -> bytes:
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def _remove(part: Path) -> None:
    with contextlib.suppress(OSError):
        part.unlink(missing_ok=True)
