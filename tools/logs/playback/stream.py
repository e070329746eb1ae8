"""Gives the messages of a window of a log in order, block by block; a long log fits too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from typing import Final, TypeAlias

from shared.clock import NS_PER_S
from tools.logs.playback.schedule import Entry, Window

BLOCK_NS: Final = 60 * NS_PER_S
"""Length of a block: some 160 MB of messages."""

Read: TypeAlias = Callable[[int, int], Sequence[Entry]]
"""Returns the messages from a time, inclusive, to another, exclusive; sorted."""


class EntryStream:
    """The messages of a window; while one block is given, the next is read."""

    def __init__(
        self,
        read: Read,
        part: Window,
        executor: Executor | None = None,
        block_ns: int = BLOCK_NS,
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
