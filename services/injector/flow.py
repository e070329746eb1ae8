"""One direction of one connection: what came in, when it goes out."""

from __future__ import annotations

import socket
from typing import Final

from services.injector.wire import Splitter, carries_messages
from shared.impairment import HELD, Direction

PENDING_MAX: Final = 262_144
"""Bytes that wait for a receiver that takes none: then the sender is read no more, as on a
link of its own."""
_READ: Final = 65_536


class Flow:
    """Reads batches from one end, and writes each to the other end when it is due."""

    def __init__(self, source: socket.socket, sink: socket.socket, direction: Direction) -> None:
        """Take two connected sockets that do not block.

        Args:
            source: where batches come from.
            sink: where they go.
            direction: what is done to them.
        """
        self.source, self.sink, self.direction = source, sink, direction
        self.ended = False
        """The source has nothing more to say."""
        self.broken = False
        """The sink takes nothing any more."""
        self._splitter = Splitter()
        self._pending = bytearray()
        self._free_ns = 0

    @property
    def writes(self) -> bool:
        """True while bytes wait for the sink."""
        return bool(self._pending)

    @property
    def reads(self) -> bool:
        """True while the source is to be read: not while too much waits for the sink."""
        return len(self._pending) < PENDING_MAX

    def take(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Read what there is; return (release time, batch), several of one batch if doubled.

        The end of the source is an empty batch: it is seen on the other side as late as all
        else.
        """
        try:
            data = self.source.recv(_READ)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self.ended = True
            return [(self._later(now_ns), b"")]
        found = []
        for batch in self._splitter.feed(data):
            if carries_messages(batch):
                releases = self.direction.passes(now_ns, len(batch))
                found += [(self._not_before(t), batch) for t in releases]
            else:
                found.append((self._later(now_ns), batch))
        return found

    def put(self, batch: bytes) -> None:
        """Write a batch that is due, or keep what the sink does not take."""
        if self._pending:
            self._pending += batch
            return
        try:
            sent = self.sink.send(batch)
        except BlockingIOError:
            sent = 0
        except OSError:
            self.broken = True
            return
        if sent < len(batch):
            self._pending += batch[sent:]

    def flush(self) -> None:
        """Write what the sink takes."""
        try:
            sent = self.sink.send(self._pending)
        except BlockingIOError:
            return
        except OSError:
            self.broken = True
            self._pending.clear()
            return
        del self._pending[:sent]

    def _later(self, now_ns: int) -> int:
        """Return when what must not be lost comes out; in order with all that must not be."""
        impairer = self.direction.in_force
        release_ns = now_ns if impairer is None else impairer.delays(now_ns)
        if release_ns != HELD:
            release_ns = self._free_ns = max(release_ns, self._free_ns)
        return release_ns

    def _not_before(self, release_ns: int) -> int:
        """Return a message's release; on a stream not before what went before it.

        Also once it is over: what was held up then still stands before it.
        """
        impairer = self.direction.in_force
        if release_ns == HELD:
            return HELD
        if impairer is not None and impairer.what.ordered:
            self._free_ns = max(self._free_ns, release_ns)
            return self._free_ns
        return release_ns
