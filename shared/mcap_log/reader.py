"""Reads an MCAP file that is finished, cut off anywhere, or damaged.

Every whole record is given, in the order of the file. Where the file ends inside a chunk, so are
the messages that can be read of its start. After damage, reading continues at the next chunk that
proves to be one.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import stat
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord

from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.mcap_log.records import (
    CHUNK_TIMES,
    DECOMPRESSED_MAX,
    KNOWN,
    MAGIC,
    PREFIX,
    ChunkMessage,
    Malformed,
    decode,
    decode_chunk,
    decompressed,
    decompressed_start,
    split_chunk,
)

_FOOTER_LENGTH: Final = 20
_TAIL: Final = PREFIX.size + _FOOTER_LENGTH + len(MAGIC)
_CHUNK_MARKS: Final = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4")
_MARK_AT: Final = PREFIX.size + CHUNK_TIMES.size
"""Offset of a chunk's compression from its start."""
IN_LINE_NS: Final = 10 * NS_PER_S
"""A recorder flushes four times a second: a chunk with longer times, or so far off, is opened."""
_CHANNEL: Final = struct.Struct("<H")  # of a message index
_LOOSE_HEAD: Final = struct.Struct("<HIQQ")  # of a message that is in no chunk


EXPANSION_MAX: Final = 50
"""A run's chunks are four to ten times as large as they are compressed."""
EXPANDED_MIN: Final = 1 << 28
"""Bytes that any file may expand to."""


class LogRecord(NamedTuple):
    """One record that could be read."""

    opcode: int
    start: int
    """Offset of the record in the file."""
    end: int
    body: bytes
    """Content of the record; of a chunk, its decompressed data."""
    value: McapRecord | None = None
    """The record decoded; None for a message or an index."""
    rows: Sequence[ChunkMessage] = ()
    """Messages of the chunk, or the message itself: `body[row.start:row.end]` is the payload."""
    definitions: Sequence[LogRecord] = ()
    """Schemas and channels inside the chunk."""
    whole: bool = True
    """False: the start of a chunk in which the file ends."""

    def values(self) -> Iterator[McapRecord]:
        """Yield the decoded record and those inside the chunk."""
        for record in (self, *self.definitions):
            if record.value is not None:
                yield record.value


class LostBytes(NamedTuple):
    """Bytes that hold nothing readable, and when they were written if they still say it."""

    start: int
    end: int
    first_ns: int = 0
    last_ns: int = 0
    """Log times; 0: unknown."""


class ChunkPlace(NamedTuple):
    """A chunk that was found and not opened, or a message that is in no chunk."""

    start: int
    """Offset of its record in the file."""
    first_ns: int
    last_ns: int
    """Log times of its messages."""
    channels: frozenset[int] | None
    """Channels with a message in it; None: unknown."""


class LogReader:
    """Reads one file. Iterate over it once; then `cut` and `damage` say what was lost.

    Or `skim` it, and `read_at` the places that are needed.
    """

    def __init__(self, data: bytes | mmap.mmap) -> None:
        """Take the file's bytes, which begin with the magic."""
        self._data = data
        self.size = len(data)
        self.finished = False
        """The recorder wrote the end of the file."""
        self.cut: LostBytes | None = None
        """What follows the last whole record of an unfinished file."""
        self.damage: list[LostBytes] = []
        """Places in the middle that could not be read."""
        self._encodings: dict[int, str] = {}
        self._marks = list(_CHUNK_MARKS)
        self._expanded = 0
        self._end = self.size
        self._summary_start = self._find_summary()

    def __iter__(self) -> Iterator[LogRecord]:
        """Yield every record up to the end of the data, the summary's channels first.

        The channels and schemas at the end of a finished file are copies of those in its first
        chunk. They replace them if that chunk is damaged.
        """
        yield from self._summary()
        at = len(MAGIC)
        while at < self._end:
            record, at = self._next(at)
            if record is not None:
                if record.opcode == Opcode.DATA_END:
                    return
                self._learn(record)
                yield record

    def skim(self) -> Iterator[LogRecord | ChunkPlace]:
        """Yield what iteration does, but the places of the chunks in place of their contents.

        Only the heads of chunks are touched: damage within one shows when it is read. No CRC
        covers the times in a head, so a chunk with times out of line is opened for those of its
        messages.
        """
        yield from self._summary()
        at = len(MAGIC)
        last_ns: int | None = None
        while at < self._end:
            place, following = self._place(at)
            if place is not None and _is_in_line(place, last_ns):
                yield place
                at, last_ns = following, place.last_ns
                continue
            start = at
            record, at = self._next(at)
            if record is None:
                continue
            if record.opcode == Opcode.DATA_END:
                return
            self._learn(record)
            if record.rows:
                channels = frozenset(row.channel_id for row in record.rows)
                times = [row.log_ns for row in record.rows]
                last_ns = max(times)
                yield ChunkPlace(start, min(times), last_ns, channels)
            else:
                yield record

    def read_at(self, start: int) -> LogRecord | None:
        """Return the record at a place that `skim` found; None if it turns out damaged.

        Raises:
            RunError: what was read so far is far larger than any run of that size.
        """
        damage, self.damage = self.damage, []
        record, _ = self._next(start)
        self._expanded += len(record.body) if record is not None else 0
        if self._expanded > max(EXPANDED_MIN, EXPANSION_MAX * self.size):
            raise RunError(
                f"its {self.size >> 10} KiB expand to over {self._expanded >> 20} MiB: that is no "
                "record of this project"
            )
        self.damage = damage + [loss for loss in self.damage if loss not in damage]
        if record is not None:
            self._learn(record)
        return record

    def _place(self, at: int) -> tuple[ChunkPlace | None, int]:
        """Return a chunk's place and the offset behind its indices; None for other records."""
        opcode, end = self._head(at)
        if opcode != Opcode.CHUNK or end > self._end or not self._plausible(end):
            return None, at
        first_ns, last_ns = CHUNK_TIMES.unpack_from(self._data, at + PREFIX.size)[:2]
        channels = set()
        following = end
        while True:
            opcode, end = self._head(following)
            if opcode != Opcode.MESSAGE_INDEX or end > self._end:
                break
            channels.add(_CHANNEL.unpack_from(self._data, following + PREFIX.size)[0])
            following = end
        return ChunkPlace(at, first_ns, last_ns, frozenset(channels) or None), following

    def _head(self, at: int) -> tuple[int, int]:
        """Return the opcode of the record at a place and the offset of its end; 0 if none fits."""
        if self._end - at < PREFIX.size + CHUNK_TIMES.size:
            return 0, self._end
        opcode, length = PREFIX.unpack_from(self._data, at)
        return opcode, at + PREFIX.size + length

    def raw(self, start: int, end: int) -> bytes:
        """Return the file's bytes from one place to another."""
        return self._data[start:end]

    def _next(self, at: int) -> tuple[LogRecord | None, int]:
        """Return the record at a place, if it can be read, and where to go on."""
        if self._end - at < PREFIX.size:
            return None, self._lost(at, self._end)
        opcode, length = PREFIX.unpack(self._data[at : at + PREFIX.size])
        start, end = at + PREFIX.size, at + PREFIX.size + length
        if end > self._end:
            following = self._chunk_after(at + 1)
            if following is None and opcode == Opcode.CHUNK and not self.finished:
                return self._cut_chunk(at, start), self._end
            return None, self._lost(at, following)
        try:
            return self._record(opcode, at, start, end), end
        except Malformed:
            # Either its content is wrong, or its length: then no record follows it.
            following = end if self._plausible(end) else self._chunk_after(at + 1)
            return None, self._lost(at, following, *_times(self._data[start:end], opcode))

    def _record(self, opcode: int, at: int, start: int, end: int) -> LogRecord:
        body = self._data[start:end]
        if opcode == Opcode.CHUNK:
            chunk = decode_chunk(body)
            content = decompressed(chunk)
            rows, others = split_chunk(content)
            return LogRecord(opcode, at, end, content, chunk, rows, _definitions(others))
        if opcode == Opcode.MESSAGE:
            if len(body) < _LOOSE_HEAD.size:
                raise Malformed
            row = ChunkMessage._make((*_LOOSE_HEAD.unpack_from(body), _LOOSE_HEAD.size, len(body)))
            if row.channel_id not in self._encodings:
                raise Malformed
            return LogRecord(opcode, at, end, body, rows=(row,))
        return LogRecord(opcode, at, end, body, decode(opcode, body))

    def _cut_chunk(self, at: int, start: int) -> LogRecord | None:
        """Return the messages at the start of the chunk in which the file ends."""
        self.cut = LostBytes(at, self.size)
        body = self._data[start : self.size]
        try:
            chunk = decode_chunk(body, cut=True)
            content = decompressed_start(chunk)
        except Malformed:
            return None
        first_ns, end_ns = chunk.message_start_time, chunk.message_end_time
        rows, others = split_chunk(content)
        definitions = _definitions(others)
        for definition in definitions:
            self._learn(definition)
        good = []
        for row in rows:
            if not (self._is_sound(content, row) and first_ns <= row.log_ns <= end_ns):
                break
            good.append(row)
        last_ns = good[-1].log_ns if good else first_ns
        self.cut = LostBytes(at, self.size, last_ns, end_ns)
        return LogRecord(
            Opcode.CHUNK, at, self.size, content, chunk, good, definitions, whole=False
        )

    def _is_sound(self, content: bytes, row: ChunkMessage) -> bool:
        """Return False for a payload that does not fit its channel's encoding; no CRC covers it."""
        encoding = self._encodings.get(row.channel_id)
        if encoding != "json":
            return encoding is not None
        try:
            msgspec.json.decode(content[row.start : row.end])
        except (msgspec.DecodeError, UnicodeDecodeError):
            return False
        return True

    def _learn(self, record: LogRecord) -> None:
        for value in record.values():
            if isinstance(value, Channel):
                self._encodings[value.id] = value.message_encoding

    def _lost(self, start: int, following: int | None, first_ns: int = 0, last_ns: int = 0) -> int:
        """Note that bytes are lost, up to the next readable ones; return where those are."""
        end = self._end if following is None else following
        loss = LostBytes(start, end, first_ns, last_ns)
        if end < self._end or self.finished:
            self.damage.append(loss)
        else:
            self.cut = loss
        return end

    def _plausible(self, at: int) -> bool:
        """Return True if a record may begin here, or the data ends here."""
        head = self._data[at : at + PREFIX.size]
        if at >= self._end or len(head) < PREFIX.size:
            return at <= self._end
        opcode, length = PREFIX.unpack(head)
        return opcode in KNOWN and length <= DECOMPRESSED_MAX

    def _chunk_after(self, at: int) -> int | None:
        """Return where the next chunk is that is whole and right, or None."""
        while True:
            marks = {mark: self._data.find(mark, at + _MARK_AT, self._end) for mark in self._marks}
            self._marks = [mark for mark, place in marks.items() if place >= 0]
            if not self._marks:
                return None
            at = min(marks[mark] for mark in self._marks) - _MARK_AT
            opcode, length = PREFIX.unpack(self._data[at : at + PREFIX.size])
            start, end = at + PREFIX.size, at + PREFIX.size + length
            if opcode == Opcode.CHUNK and end <= self._end:
                with contextlib.suppress(Malformed):
                    self._record(opcode, at, start, end)
                    return at
            at += 1

    def _find_summary(self) -> int:
        """Look for the end of a finished file; return where its summary starts."""
        tail = self._data[max(0, self.size - _TAIL) : self.size]
        if len(tail) < _TAIL or not tail.endswith(MAGIC):
            return 0
        opcode, length = PREFIX.unpack(tail[: PREFIX.size])
        if (opcode, length) != (Opcode.FOOTER, _FOOTER_LENGTH):
            return 0
        self.finished = True
        self._end = self.size - _TAIL
        start = int.from_bytes(tail[PREFIX.size : PREFIX.size + 8], "little")
        if not len(MAGIC) < start < self._end:
            return 0
        self._end = start
        return start

    def _summary(self) -> Iterator[LogRecord]:
        at, end = self._summary_start, self.size - _TAIL
        while 0 < at <= end - PREFIX.size:
            opcode, length = PREFIX.unpack(self._data[at : at + PREFIX.size])
            start, at = at, at + PREFIX.size + length
            if at > end:
                return
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                with contextlib.suppress(Malformed):
                    yield self._record(opcode, start, start + PREFIX.size, at)


def _definitions(records: Sequence[tuple[int, bytes]]) -> tuple[LogRecord, ...]:
    """Return the schemas and channels among a chunk's records; a malformed one is left out."""
    found = []
    for opcode, body in records:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            with contextlib.suppress(Malformed):
                found.append(LogRecord(opcode, 0, 0, body, decode(opcode, body)))
    return tuple(found)


def _is_in_line(place: ChunkPlace, before_ns: int | None) -> bool:
    """Return True for a chunk whose times are believed: it follows the one before it closely."""
    began_ns = place.first_ns if before_ns is None else before_ns
    return (
        place.first_ns <= place.last_ns <= place.first_ns + IN_LINE_NS
        and abs(place.first_ns - began_ns) <= IN_LINE_NS
    )


def _times(body: bytes, opcode: int) -> tuple[int, int]:
    if opcode != Opcode.CHUNK or len(body) < CHUNK_TIMES.size:
        return 0, 0
    first_ns, last_ns, _, _ = CHUNK_TIMES.unpack_from(body)
    return first_ns, last_ns


@contextlib.contextmanager
def open_log(path: Path) -> Iterator[LogReader]:
    """Open a file to read what can be read of it.

    Raises:
        RunError: it is missing, a directory or no ordinary file, empty, or no MCAP file.
    """
    with contextlib.ExitStack() as stack:
        try:
            mode = path.stat().st_mode
            if stat.S_ISDIR(mode):
                raise RunError(f"{path}: cannot be read: a directory; give an MCAP file in it")
            if not stat.S_ISREG(mode):  # a pipe would be waited on for ever
                raise RunError(f"{path}: cannot be read: no ordinary file; give an MCAP file")
            file = stack.enter_context(path.open("rb"))
            if not os.fstat(file.fileno()).st_size:
                raise RunError(f"{path}: is empty; an MCAP file is right")
            data = stack.enter_context(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        except OSError as error:
            found = f"cannot be read: {error.strerror}"
            raise RunError(f"{path}: {found}; give an MCAP file") from None
        if data[: len(MAGIC)] != MAGIC:
            raise RunError(f"{path}: is no MCAP file (wrong first bytes)")
        yield LogReader(data)
