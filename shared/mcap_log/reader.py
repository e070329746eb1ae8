"""Read an MCAP file that is finished, cut off anywhere, or damaged.

The reader yields every whole record in the order of the file. Consecutive messages outside of
chunks are yielded as one record, like those of a chunk. Private records, and kinds that the format
does not define, are yielded without content. If the file ends inside a chunk, the readable messages
at its start are yielded. After damage, reading continues at the next valid chunk.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import stat
import struct
import zlib
from collections import Counter
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
    CRC,
    DECOMPRESSED_MAX,
    EXPANSION_MAX,
    KNOWN,
    MAGIC,
    MESSAGE_RECORD,
    PREFIX,
    Chunk,
    ChunkMessage,
    Malformed,
    decode,
    decode_chunk,
    decompressed,
    decompressed_start,
    split_chunk,
    split_messages,
)

_FOOTER_LENGTH: Final = 20
_TAIL: Final = PREFIX.size + _FOOTER_LENGTH + len(MAGIC)
_CHUNK_MARKS: Final = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4")
_MARK_AT: Final = PREFIX.size + CHUNK_TIMES.size
"""Offset of a chunk's compression from its start."""
IN_LINE_NS: Final = 10 * NS_PER_S
"""Maximum duration of a chunk, and maximum distance from the chunk before it, for its times to be
trusted. A recorder flushes four times a second."""
_INDEX_HEAD: Final = struct.Struct("<HI")  # of a message index: channel, size of its entries
_ENTRY: Final = struct.Struct("<QQ")  # of a message index: log time, offset in the chunk
_DEFINITIONS: Final = (Opcode.SCHEMA, Opcode.CHANNEL)
LOOSE_MAX: Final = 1 << 20
"""Size of the pieces in which messages outside of chunks are yielded and copied, bytes."""

EXPANDED_MIN: Final = 1 << 28
"""Size to which even the smallest file may expand, bytes."""


class LostBytes(msgspec.Struct, frozen=True):
    """Bytes that cannot be read, and their log times if these are known."""

    start: int
    end: int
    first_ns: int = 0
    last_ns: int = 0
    """Log times; 0: unknown."""
    missing: int | None = None
    """Number of messages missing from a damaged chunk that is readable in part; None: unknown."""


class LogRecord(NamedTuple):
    """One readable record, or consecutive messages outside of chunks."""

    opcode: int
    start: int
    """Offset of the record in the file."""
    end: int
    body: bytes
    """Content of the record; of a chunk, its decompressed data; of messages, their records."""
    value: McapRecord | None = None
    """The record decoded; None for a message or an index."""
    rows: Sequence[ChunkMessage] = ()
    """The messages: `body[row.start:row.end]` is the payload of each."""
    definitions: Sequence[LogRecord] = ()
    """Schemas and channels inside the chunk."""
    lost: LostBytes | None = None
    """Missing part of a chunk that can be read in part."""

    def values(self) -> Iterator[McapRecord]:
        """Yield the decoded record, and those decoded inside a chunk."""
        for record in (self, *self.definitions):
            if record.value is not None:
                yield record.value


class ChunkPlace(NamedTuple):
    """Location of a chunk, or of messages outside of chunks, for `LogReader.read_at`."""

    start: int
    """Offset of its record in the file."""
    first_ns: int
    last_ns: int
    """Log times of its messages."""
    channels: frozenset[int] | None
    """Channels with a message in it; None: unknown."""


class LogReader:
    """Reader of one file. Iterate over it once; then `cut` and `damage` list the losses.

    Alternatively call `skim`, then `read_at` for the places that are needed.
    """

    def __init__(self, data: bytes | mmap.mmap) -> None:
        self._data = data
        self.size = len(data)
        self.finished = False
        """True if the recorder wrote the end of the file."""
        self.cut: LostBytes | None = None
        """Bytes after the last whole record of an unfinished file."""
        self.damage: list[LostBytes] = []
        """Places in the middle that could not be read."""
        self.passed_over = 0
        """Number of records of unknown kinds."""
        self.earlier_ends = 0
        """Number of ends with more data after them: the writer finished the file more than once."""
        self.in_summary: Counter[int] = Counter()
        """Number of records in the summary, by opcode."""
        self.message_count: int | None = None
        """Number of messages in the summary's statistics; None if these are missing or damaged."""
        self._encodings: dict[int, str] = {}
        self._vouched = 0
        """Offset up to which records of unknown kinds are known to lead to a known one."""
        self._marks = list(_CHUNK_MARKS)
        self._expanded = 0
        self._end = self.size
        self._sound = False  # the summary's CRC is right
        self._summary_start = self._find_summary()

    def __iter__(self) -> Iterator[LogRecord]:
        """Yield every record up to the end of the data, the summary's channels first.

        The channels and schemas at the end of a finished file are copies of those in its first
        chunk, and replace them if that chunk is damaged.
        """
        yield from self._summary()
        at = len(MAGIC)
        while at < self._end:
            record, at = self._next(at)
            if record is not None:
                if record.opcode == Opcode.DATA_END:
                    at = self._behind_data_end(at)
                    continue
                self._learn(record)
                yield record

    def skim(self) -> Iterator[LogRecord | ChunkPlace]:
        """Yield the same records as iteration, but places instead of messages.

        Only the heads of chunks are read, so damage within a chunk is found only by `read_at`. No
        CRC covers the times in a head. So a chunk with implausible times is opened to read its
        messages' times. A chunk with channels that no earlier record described is opened, too.
        """
        yield from self._summary()
        described = bool(self._encodings)
        at = len(MAGIC)
        last_ns: int | None = None
        while at < self._end:
            place, following = self._place(at)
            known = (
                described
                if place is None or place.channels is None
                else (place.channels <= self._encodings.keys())
            )
            if place is not None and known and _is_in_line(place, last_ns):
                yield place
                at, last_ns = following, place.last_ns
                continue
            start = at
            record, at = self._next(at)
            if record is None:
                continue
            if record.opcode == Opcode.DATA_END:
                at = self._behind_data_end(at)
                continue
            self._learn(record)
            if record.rows:
                channels = frozenset(row.channel_id for row in record.rows)
                times = [row.log_ns for row in record.rows]
                last_ns = max(times)
                yield from record.definitions
                yield ChunkPlace(start, min(times), last_ns, channels)
            else:
                yield record

    def read_at(self, start: int) -> LogRecord | None:
        """Return the record at a place that `skim` found; None if it is damaged.

        Raises RunError if the records read so far are far larger than in any run of this file size.
        """
        damage, self.damage = self.damage, []
        record, _ = self._next(start)
        self._expanded += len(record.body) if record is not None else 0
        if self._expanded > max(EXPANDED_MIN, EXPANSION_MAX * self.size):
            raise RunError(
                f"its content of {self.size >> 10} KiB expands to over {self._expanded >> 20} MiB: "
                "this is not a log of this project"
            )
        self.damage = damage + [loss for loss in self.damage if loss not in damage]
        if record is not None:
            self._learn(record)
        return record

    def _place(self, at: int) -> tuple[ChunkPlace | None, int]:
        """Return a chunk's place and the offset after its indices; None for other records."""
        opcode, start, following = self._extent(at)
        if opcode != Opcode.CHUNK or not start + CHUNK_TIMES.size <= following <= self._end:
            return None, at
        if not self._plausible(following):
            return None, at
        first_ns, last_ns, _, _ = CHUNK_TIMES.unpack_from(self._data, start)
        channels = set()
        for number, entries, behind in self._indices(following):
            if entries:
                channels.add(number)
            following = behind
        opcode, _, end = self._extent(following)
        if opcode in (0, Opcode.MESSAGE_INDEX) and end > self._end:  # one of its indices is cut
            channels.clear()
        return ChunkPlace(at, first_ns, last_ns, frozenset(channels) or None), following

    def _indices(self, at: int) -> Iterator[tuple[int, bytes, int]]:
        """Yield each message index from an offset on: its channel, its entries, its end."""
        while True:
            opcode, start, end = self._extent(at)
            start += _INDEX_HEAD.size
            if opcode != Opcode.MESSAGE_INDEX or not start <= end <= self._end:
                return
            number, size = _INDEX_HEAD.unpack_from(self._data, start - _INDEX_HEAD.size)
            yield number, self._data[start : min(start + size, end)], end
            at = end

    def raw(self, start: int, end: int) -> bytes:
        """Return the file's bytes from one offset to another."""
        return self._data[start:end]

    def _next(self, at: int) -> tuple[LogRecord | None, int]:
        """Return the record at an offset, if it can be read, and the offset to continue at."""
        if self._end - at < PREFIX.size:
            return None, self._lost(at, self._end)
        opcode, start, end = self._extent(at)
        if end > self._end:
            following = self._chunk_after(at + 1)
            if following is None and opcode == Opcode.CHUNK and not self.finished:
                return self._cut_chunk(at, start), self._end
            return None, self._lost(at, following)
        try:
            record = self._record(opcode, at, start, end)
        except Malformed:
            # Its content is wrong, or its length. If its length is wrong, no record follows it.
            following = end if self._plausible(end) else self._chunk_after(at + 1)
            return None, self._lost(at, following, *_times(self._data[start:end], opcode))
        if record.lost is not None:
            self.damage.append(record.lost)
        return record, record.end

    def _record(self, opcode: int, at: int, start: int, end: int) -> LogRecord:
        # a message index follows only a chunk: any other record before an index is a damaged chunk
        index_follows = self._extent(end)[0] == Opcode.MESSAGE_INDEX
        if opcode == Opcode.MESSAGE:
            rows, end = split_messages(self._data, at, self._end, enough=LOOSE_MAX, origin=at)
            if not rows or (len(rows) == 1 and index_follows):
                raise Malformed
            return LogRecord(opcode, at, end, self._data[at:end], rows=rows)
        if opcode not in KNOWN:
            if not opcode or index_follows or not self._leads_on(end):
                raise Malformed
            self.passed_over += 1
            return LogRecord(opcode, at, end, b"")
        body = self._data[start:end]
        if opcode == Opcode.CHUNK:
            chunk, size = decode_chunk(body)
            record = self._opened(at, end, chunk)
        else:
            value, size = decode(opcode, body)
            record = LogRecord(opcode, at, end, body, value)
        if size < len(body) and not self._leads_on(end):
            raise Malformed  # not a field of a later version: the length is wrong
        return record

    def _opened(self, at: int, end: int, chunk: Chunk) -> LogRecord:
        """Return a chunk's records. A CRC proves its bytes, and the indices prove its records.

        Records that a writer did not complete are left out.
        """
        content = decompressed(chunk)
        rows, others, whole = split_chunk(content)
        indices = [entries for _, entries, _ in self._indices(end)]
        counted = sum(len(entries) // _ENTRY.size for entries in indices)
        if not whole and (places := _places(content, indices)):
            # The next record may begin within an incomplete one: only the indices give its offset.
            others = split_chunk(content, places).others
            found = [split_messages(content, place, len(content), enough=1) for place in places]
            rows = [row for messages, _ in found for row in messages]
        definitions = _definitions(others)
        described = sum(opcode in _DEFINITIONS for opcode, _ in others)
        lost = None
        if not whole or counted > len(rows) or described > len(definitions):
            times = chunk.message_start_time, chunk.message_end_time
            lost = LostBytes(at, end, *times, max(0, counted - len(rows)))
        return LogRecord(Opcode.CHUNK, at, end, content, chunk, rows, definitions, lost)

    def _behind_data_end(self, at: int) -> int:
        """Return the offset at which to continue after a data end record.

        This is the end of the data, unless more follows. A writer that finished and then accepted
        further messages has written its first summary, footer and magic in the middle of the file,
        or only a part of them if finishing failed.
        """
        if at >= self._end:
            return at
        if self._extent(at)[0] in KNOWN - {*_DEFINITIONS}:
            self.earlier_ends += 1
            return at
        magic = self._data.find(MAGIC, at, self._end)
        if magic < 0:
            chunk = self._chunk_after(at)
            if chunk is None and not self.finished:
                return self._end  # cut off in its summary: no message is lost
            return self._lost(at, chunk)
        following = magic + len(MAGIC)
        if self._data[following : following + len(MAGIC)] == MAGIC:
            return self._lost(at, None)  # another file, with channels of the same numbers
        self.earlier_ends += 1
        return following

    def _leads_on(self, at: int) -> bool:
        """Return True if a known record follows, possibly after unknown ones, or the data ends.

        A record that is only skipped has no other proof of its length.
        """
        at = max(at, self._vouched)
        while self._end - at >= PREFIX.size:
            opcode, _, end = self._extent(at)
            if opcode in KNOWN:
                break
            if not opcode:
                return False
            at = end
        if not self._plausible(at):
            return False
        self._vouched = at
        return True

    def _cut_chunk(self, at: int, start: int) -> LogRecord | None:
        """Return the messages at the start of the chunk in which the file ends."""
        self.cut = LostBytes(at, self.size)
        body = self._data[start : self.size]
        try:
            chunk, _ = decode_chunk(body, cut=True)
            content = decompressed_start(chunk)
        except Malformed:
            return None
        first_ns, end_ns = chunk.message_start_time, chunk.message_end_time
        rows, others, _ = split_chunk(content)
        definitions = _definitions(others)
        for definition in definitions:
            self._learn(definition)
        good = []
        for row in rows:
            if not (self._is_sound(content, row) and first_ns <= row.log_ns <= end_ns):
                break
            good.append(row)
        # messages are not always in the order of their times: ours are grouped by key
        self.cut = LostBytes(at, self.size, first_ns, end_ns)
        return LogRecord(Opcode.CHUNK, at, self.size, content, chunk, good, definitions, self.cut)

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
        """Record a loss of bytes up to the next readable ones; return their offset."""
        end = self._end if following is None else following
        loss = LostBytes(start, end, first_ns, last_ns)
        if end < self._end or self.finished:
            self.damage.append(loss)
        else:
            self.cut = loss
        return end

    def _plausible(self, at: int) -> bool:
        """Return True if a record may begin here, or the data ends here."""
        if self._end - at < PREFIX.size:
            return at <= self._end
        opcode, start, end = self._extent(at)
        return opcode in KNOWN and (end <= self._end or end - start <= DECOMPRESSED_MAX)

    def _extent(self, at: int) -> tuple[int, int, int]:
        """Return the opcode of the record at an offset, and where its content begins and ends.

        The opcode is 0, and the end beyond the data's, if the data ends within its prefix.
        """
        start = at + PREFIX.size
        if start > self._end:
            return 0, start, start
        opcode, length = PREFIX.unpack_from(self._data, at)
        return opcode, start, start + length

    def _chunk_after(self, at: int) -> int | None:
        """Return the offset of the next whole and valid chunk, or None."""
        while True:
            marks = {mark: self._data.find(mark, at + _MARK_AT, self._end) for mark in self._marks}
            self._marks = [mark for mark, place in marks.items() if place >= 0]
            if not self._marks:
                return None
            at = min(marks[mark] for mark in self._marks) - _MARK_AT
            opcode, start, end = self._extent(at)
            if opcode == Opcode.CHUNK and end <= self._end:
                with contextlib.suppress(Malformed):
                    self._record(opcode, at, start, end)
                    return at
            at += 1

    def _find_summary(self) -> int:
        """Look for the end of a finished file; return the offset of its summary, else 0."""
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
        (crc,) = CRC.unpack_from(tail, PREFIX.size + _FOOTER_LENGTH - CRC.size)
        vouched = self._data[start : self.size - len(MAGIC) - CRC.size]
        self._sound = crc in (0, zlib.crc32(vouched))
        if self._sound:  # else the data's end is unknown, and bytes after it show as damage
            self._end = start
        return start

    def _summary(self) -> Iterator[LogRecord]:
        at, end = self._summary_start, self.size - _TAIL
        while 0 < at <= end - PREFIX.size:
            opcode, length = PREFIX.unpack(self._data[at : at + PREFIX.size])
            start, at = at, at + PREFIX.size + length
            if at > end:
                return
            self.in_summary[opcode] += 1
            if opcode == Opcode.STATISTICS and self._sound:
                count = self._data[start + PREFIX.size : start + PREFIX.size + 8]
                self.message_count = int.from_bytes(count, "little")
            if opcode in _DEFINITIONS:
                with contextlib.suppress(Malformed):
                    record = self._record(opcode, start, start + PREFIX.size, at)
                    self._learn(record)
                    yield record


def _definitions(records: Sequence[tuple[int, bytes]]) -> tuple[LogRecord, ...]:
    """Return the schemas and channels among a chunk's records; a malformed one is left out."""
    found = []
    for opcode, body in records:
        if opcode in _DEFINITIONS:
            with contextlib.suppress(Malformed):
                found.append(LogRecord(opcode, 0, 0, body, decode(opcode, body)[0]))
    return tuple(found)


def _places(content: bytes, indices: Sequence[bytes]) -> list[int]:
    """Return the offsets of the messages that a chunk's indices list."""
    found = []
    for entries in indices:
        for log_ns, at in _ENTRY.iter_unpack(entries[: len(entries) // _ENTRY.size * _ENTRY.size]):
            if at + MESSAGE_RECORD.size <= len(content):
                opcode, _, _, _, here_ns, _ = MESSAGE_RECORD.unpack_from(content, at)
                if (opcode, here_ns) == (Opcode.MESSAGE, log_ns):
                    found.append(at)
    return sorted(found)


def _is_in_line(place: ChunkPlace, before_ns: int | None) -> bool:
    """Return True if a chunk's times are plausible: it closely follows the one before it."""
    began_ns = place.first_ns if before_ns is None else before_ns
    return (
        place.last_ns > 0  # else it has no messages
        and place.first_ns <= place.last_ns <= place.first_ns + IN_LINE_NS
        and abs(place.first_ns - began_ns) <= IN_LINE_NS
    )


def _times(body: bytes, opcode: int) -> tuple[int, int]:
    if opcode != Opcode.CHUNK or len(body) < CHUNK_TIMES.size:
        return 0, 0
    first_ns, last_ns, _, _ = CHUNK_TIMES.unpack_from(body)
    return first_ns, last_ns


@contextlib.contextmanager
def open_log(path: Path) -> Iterator[LogReader]:
    """Open a file and yield a reader of its readable parts.

    Raises RunError for a missing or empty file, a directory, a pipe, and a file that is not MCAP.
    """
    with contextlib.ExitStack() as stack:
        try:
            mode = path.stat().st_mode
            if stat.S_ISDIR(mode):
                raise RunError(
                    f"{path}: cannot be read: it is a directory; give an MCAP file in it"
                )
            if not stat.S_ISREG(mode):  # reading a pipe would block forever
                raise RunError(f"{path}: cannot be read: not a regular file; give an MCAP file")
            file = stack.enter_context(path.open("rb"))
            if not os.fstat(file.fileno()).st_size:
                raise RunError(f"{path}: empty file; give an MCAP file")
            data = stack.enter_context(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        except OSError as error:
            found = f"cannot be read: {error.strerror}"
            raise RunError(f"{path}: {found}; give an MCAP file") from None
        if data[: len(MAGIC)] != MAGIC:
            raise RunError(f"{path}: wrong first bytes; give an MCAP file")
        yield LogReader(data)
