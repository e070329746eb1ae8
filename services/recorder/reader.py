"""What can be read of an MCAP file: finished, cut off anywhere, or damaged.

Every record that is whole is given, in the order of the file. Where the file ends within
a chunk, the messages that can be had of its start are given as well. Behind damage the
reading goes on at the next chunk that proves to be one.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import stat
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from services.recorder import mcap_records as mcap
from services.recorder.mcap_records import Chunk, ChunkMessage, Malformed
from shared.exceptions import RunError

_FOOTER_LENGTH: Final = 20
_TAIL: Final = mcap.PREFIX.size + _FOOTER_LENGTH + len(mcap.MAGIC)
_CHUNK_MARKS: Final = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4")
_MARK_AT: Final = mcap.PREFIX.size + mcap.CHUNK_TIMES.size
"""A chunk's compression stands so far behind its start."""
_LOOSE_HEAD: Final = struct.Struct("<HIQQ")  # of a message that is in no chunk


class Piece(NamedTuple):
    """One record that could be read."""

    opcode: int
    start: int
    """Offset of the record in the file."""
    end: int
    body: bytes
    """Content of the record; of a chunk, its decompressed content."""
    chunk: Chunk | None = None
    rows: tuple[ChunkMessage, ...] | list[ChunkMessage] = ()
    """Messages of the chunk: `body[row.start:row.end]` is the payload."""
    others: tuple[tuple[int, bytes], ...] | list[tuple[int, bytes]] = ()
    """Schemas and channels within the chunk."""
    whole: bool = True
    """False: the start of a chunk in which the file ends."""


class LostBytes(NamedTuple):
    """Bytes that hold nothing readable, and when they were written if they still say it."""

    start: int
    end: int
    first_ns: int = 0
    last_ns: int = 0
    """Log times; 0: unknown."""


class Salvage:
    """Reads one file; iterate over it once, then look at what was lost."""

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
        self._end = self.size
        self._summary_start = self._find_summary()

    def __iter__(self) -> Iterator[Piece]:
        """Give every record up to the end of the data; the summary's channels come first.

        The channels and schemas at the end of a finished file are copies of those in its
        first chunk, and stand in for them if that is the chunk that is damaged.
        """
        yield from self._summary()
        at = len(mcap.MAGIC)
        while at < self._end:
            piece, at = self._next(at)
            if piece is not None:
                if piece.opcode == mcap.DATA_END:
                    return
                self._learn(piece)
                yield piece

    def raw(self, start: int, end: int) -> bytes:
        """Return the file's bytes from one place to another."""
        return self._data[start:end]

    def _next(self, at: int) -> tuple[Piece | None, int]:
        """Return the record at a place, if it can be read, and where to go on."""
        if self._end - at < mcap.PREFIX.size:
            return None, self._lost(at, self._end)
        opcode, length = mcap.PREFIX.unpack(self._data[at : at + mcap.PREFIX.size])
        start, end = at + mcap.PREFIX.size, at + mcap.PREFIX.size + length
        if end > self._end:
            following = self._chunk_after(at + 1)
            if following is None and opcode == mcap.CHUNK and not self.finished:
                return self._cut_chunk(at, start), self._end
            return None, self._lost(at, following)
        try:
            return self._piece(opcode, at, start, end), end
        except Malformed:
            # Either its content is wrong, or its length: then no record follows it.
            following = end if self._plausible(end) else self._chunk_after(at + 1)
            return None, self._lost(at, following, *_times(self._data[start:end], opcode))

    def _piece(self, opcode: int, at: int, start: int, end: int) -> Piece:
        body = self._data[start:end]
        if opcode == mcap.CHUNK:
            head = mcap.chunk(body)
            content = mcap.inflated(head)
            rows, others = mcap.contents(content)
            return Piece(opcode, at, end, content, head, rows, others)
        if opcode == mcap.MESSAGE:
            if len(body) < _LOOSE_HEAD.size:
                raise Malformed
            row = ChunkMessage._make((*_LOOSE_HEAD.unpack_from(body), _LOOSE_HEAD.size, len(body)))
            if row.channel_id not in self._encodings:
                raise Malformed
            return Piece(opcode, at, end, body, rows=(row,))
        check = _CHECKS.get(opcode)
        if check is None:
            raise Malformed
        check(body)
        return Piece(opcode, at, end, body)

    def _cut_chunk(self, at: int, start: int) -> Piece | None:
        """Return the messages at the start of the chunk in which the file ends."""
        self.cut = LostBytes(at, self.size)
        body = self._data[start : self.size]
        try:
            head = mcap.chunk(body, cut=True)
            content = mcap.inflated_start(head)
        except Malformed:
            return None
        rows, others = mcap.contents(content)
        self._learn(Piece(mcap.CHUNK, at, self.size, b"", None, (), others))
        good = []
        for row in rows:
            if not (self._sound(content, row) and head.first_ns <= row.log_ns <= head.last_ns):
                break
            good.append(row)
        last_ns = good[-1].log_ns if good else head.first_ns
        self.cut = LostBytes(at, self.size, last_ns, head.last_ns)
        return Piece(mcap.CHUNK, at, self.size, content, head, good, others, whole=False)

    def _sound(self, content: bytes, row: ChunkMessage) -> bool:
        """Return False for a payload that is not what its channel says; no CRC vouches for it."""
        encoding = self._encodings.get(row.channel_id)
        if encoding != "json":
            return encoding is not None
        try:
            msgspec.json.decode(content[row.start : row.end])
        except (msgspec.DecodeError, UnicodeDecodeError):
            return False
        return True

    def _learn(self, piece: Piece) -> None:
        records = [*piece.others]
        if piece.opcode == mcap.CHANNEL:
            records.append((piece.opcode, piece.body))
        for opcode, body in records:
            if opcode == mcap.CHANNEL:
                with contextlib.suppress(Malformed):
                    channel = mcap.channel(body)
                    self._encodings[channel.id] = channel.encoding

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
        head = self._data[at : at + mcap.PREFIX.size]
        if at >= self._end or len(head) < mcap.PREFIX.size:
            return at <= self._end
        opcode, length = mcap.PREFIX.unpack(head)
        known = opcode in _CHECKS or opcode in (mcap.CHUNK, mcap.MESSAGE)
        return known and length <= mcap.INFLATED_MAX

    def _chunk_after(self, at: int) -> int | None:
        """Return where the next chunk is that is whole and right, or None."""
        while True:
            marks = {mark: self._data.find(mark, at + _MARK_AT, self._end) for mark in self._marks}
            self._marks = [mark for mark, place in marks.items() if place >= 0]
            if not self._marks:
                return None
            at = min(marks[mark] for mark in self._marks) - _MARK_AT
            opcode, length = mcap.PREFIX.unpack(self._data[at : at + mcap.PREFIX.size])
            start, end = at + mcap.PREFIX.size, at + mcap.PREFIX.size + length
            if opcode == mcap.CHUNK and end <= self._end:
                with contextlib.suppress(Malformed):
                    self._piece(opcode, at, start, end)
                    return at
            at += 1

    def _find_summary(self) -> int:
        """Look for the end of a finished file; return where its summary starts."""
        tail = self._data[max(0, self.size - _TAIL) : self.size]
        if len(tail) < _TAIL or not tail.endswith(mcap.MAGIC):
            return 0
        opcode, length = mcap.PREFIX.unpack(tail[: mcap.PREFIX.size])
        if (opcode, length) != (mcap.FOOTER, _FOOTER_LENGTH):
            return 0
        self.finished = True
        self._end = self.size - _TAIL
        start = int.from_bytes(tail[mcap.PREFIX.size : mcap.PREFIX.size + 8], "little")
        if not len(mcap.MAGIC) < start < self._end:
            return 0
        self._end = start
        return start

    def _summary(self) -> Iterator[Piece]:
        at, end = self._summary_start, self.size - _TAIL
        while 0 < at <= end - mcap.PREFIX.size:
            opcode, length = mcap.PREFIX.unpack(self._data[at : at + mcap.PREFIX.size])
            start, at = at, at + mcap.PREFIX.size + length
            if at > end:
                return
            if opcode in (mcap.SCHEMA, mcap.CHANNEL):
                with contextlib.suppress(Malformed):
                    yield self._piece(opcode, start, start + mcap.PREFIX.size, at)


_CHECKS: Final[dict[int, Callable[[bytes], object]]] = {
    mcap.HEADER: mcap.header,
    mcap.SCHEMA: mcap.schema,
    mcap.CHANNEL: mcap.channel,
    mcap.METADATA: mcap.metadata,
    mcap.ATTACHMENT: mcap.attachment,
    mcap.MESSAGE_INDEX: mcap.message_index,
    mcap.DATA_END: mcap.data_end,
}
"""Records that may stand beside chunks and messages; others are damage."""


def _times(body: bytes, opcode: int) -> tuple[int, int]:
    if opcode != mcap.CHUNK or len(body) < mcap.CHUNK_TIMES.size:
        return 0, 0
    first_ns, last_ns, _, _ = mcap.CHUNK_TIMES.unpack_from(body)
    return first_ns, last_ns


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Salvage]:
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
        if data[: len(mcap.MAGIC)] != mcap.MAGIC:
            raise RunError(f"{path}: is no MCAP file (wrong first bytes)")
        yield Salvage(data)
