"""Which message is played when. Pure: times in, messages out.

Two times: the clock's (monotonic, ns) and the position in the log (ns since the start of the played
part; it keeps counting when playback loops). A `Playhead` maps one to the other by a line that
changes only at a pause, a step or a change of rate, so no error adds up. A `Schedule` gives the
position of each message, and an `EntryStream` the messages, block by block: a long log fits too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from typing import Final, NamedTuple, TypeAlias

from shared.clock import NS_PER_MS, NS_PER_S

PASS_MIN_NS: Final = 100 * NS_PER_MS
"""Shortest pass of a loop: a log of one message is not played without a pause."""

RATE_MIN: Final = 0.001
RATE_MAX: Final = 1000.0


class Entry(NamedTuple):
    """A recorded message."""

    time_ns: int
    """When it reached the recorder, on the recorder's clock."""
    key: int
    """Index of its key."""
    payload: bytes


class Window(NamedTuple):
    """The part of a log that is played: `start_ns` belongs to it, `end_ns` does not."""

    start_ns: int
    end_ns: int


def window(began_ns: int, ended_ns: int, offset_ns: int, duration_ns: int | None) -> Window:
    """Return the part of a log that begins `offset_ns` after its start and lasts so long.

    Parts that follow one another hold every message once. An end beyond the log's is the
    log's.
    """
    start_ns = began_ns + offset_ns
    end_ns = ended_ns + 1
    if duration_ns is not None:
        end_ns = min(end_ns, start_ns + duration_ns)
    return Window(start_ns, end_ns)


class Playhead:
    """The position in the log as a function of the clock."""

    def __init__(self, now_ns: int, rate: float, *, paused: bool = False) -> None:
        self.rate = rate
        self.paused = paused
        self._since_ns, self._from_ns = now_ns, 0

    def position(self, now_ns: int) -> int:
        """Return where in the log the playing is."""
        if self.paused:
            return self._from_ns
        return self._from_ns + math.floor((now_ns - self._since_ns) * self.rate)

    def due_ns(self, position_ns: int) -> int | None:
        """Return the clock at which a position is reached; None while paused."""
        if self.paused:
            return None
        return self._since_ns + math.ceil((position_ns - self._from_ns) / self.rate)

    def pause(self, now_ns: int) -> None:
        """Stand still from now on."""
        self._lay(now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        """Go on from where it stands."""
        self._lay(now_ns)
        self.paused = False

    def step(self, position_ns: int) -> None:
        """Stand at a later position; for a paused one."""
        self._from_ns = max(self._from_ns, position_ns)

    def change_rate(self, now_ns: int, rate: float) -> None:
        """Go on faster or slower, within `RATE_MIN` .. `RATE_MAX`."""
        self._lay(now_ns)
        self.rate = min(max(rate, RATE_MIN), RATE_MAX)

    def _lay(self, now_ns: int) -> None:
        """Count the time from the present position on."""
        self._since_ns, self._from_ns = now_ns, self.position(now_ns)


BLOCK_NS: Final = 60 * NS_PER_S
"""Length of a block: some 160 MB of messages."""

Read: TypeAlias = Callable[[int, int], Sequence[Entry]]
"""Returns the messages from a time, inclusive, to another, exclusive; sorted."""


class EntryStream:
    """The messages of a window; while one block is given, the next is read."""

    def __init__(
        self, read: Read, part: Window, executor: Executor | None = None, block_ns: int = BLOCK_NS
    ) -> None:
        self._read, self._part, self._block_ns = read, part, block_ns
        self._executor = executor
        self.rewind()

    def rewind(self) -> None:
        """Begin again."""
        self._entries: Sequence[Entry] = ()
        self._next = 0
        self._from_ns = self._part.start_ns
        self._coming: Future[Sequence[Entry]] | None = None

    def peek(self) -> Entry | None:
        """Return the next message, which stays the next; None behind the last."""
        while self._next >= len(self._entries):
            if self._from_ns >= self._part.end_ns:
                return None
            self._entries, self._next = self._block(), 0
        return self._entries[self._next]

    def pop(self) -> Entry:
        """Return the next message, which `peek` has returned."""
        self._next += 1
        return self._entries[self._next - 1]

    def _block(self) -> Sequence[Entry]:
        """Return the next block, and have the one behind it read."""
        coming, self._coming = self._coming, None
        entries = self._read(*self._bounds()) if coming is None else coming.result()
        self._from_ns += self._block_ns
        if self._executor is not None and self._from_ns < self._part.end_ns:
            self._coming = self._executor.submit(self._read, *self._bounds())
        return entries

    def _bounds(self) -> tuple[int, int]:
        return self._from_ns, min(self._from_ns + self._block_ns, self._part.end_ns)


class Schedule:
    """The messages of a window in order, once or for ever."""

    def __init__(self, source: EntryStream, part: Window, *, loop: bool) -> None:
        self._source = source
        self._start_ns = part.start_ns
        self.length_ns = max(0, part.end_ns - part.start_ns)
        """Length of one pass, ns."""
        self.is_empty = source.peek() is None
        self._loop = loop and not self.is_empty
        self._period_ns = max(self.length_ns, PASS_MIN_NS)
        self.passes = 0
        """Passes that are over."""

    def next_ns(self) -> int | None:
        """Return the position of the next message; None behind the last."""
        entry = self._source.peek()
        if entry is None and self._loop:
            self._source.rewind()
            self.passes += 1
            entry = self._source.peek()
        if entry is None:
            return None
        return self.passes * self._period_ns + entry.time_ns - self._start_ns

    def pop(self) -> Entry:
        """Return the next message, whose position `next_ns` has returned."""
        return self._source.pop()

    def recorded_ns(self, position_ns: int) -> int:
        """Return the recorder's clock at a position, within the window."""
        return self._start_ns + self.elapsed_ns(position_ns)

    def elapsed_ns(self, position_ns: int) -> int:
        """Return the time since the start of the pass that a position belongs to."""
        if self._loop:
            position_ns %= self._period_ns
        return min(position_ns, self.length_ns)
