"""One connection of a pair: its two ends, and the batches on their way in each direction.

Zenoh's wire format (zenoh-protocol, wire version 9): on a stream, each batch starts with its
length, two bytes, little endian. A batch contains frames. A frame contains a header, a sequence
number, extensions and network messages. Application messages are PUSH. All others (opening a link,
declaring subscriptions, keep-alive) are the link's own traffic. The proxy may delay this traffic
but never drops it, because nothing retransmits it on a stream.
"""

from __future__ import annotations

import socket
import struct
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

from services.network_proxy.sockets import READ, WRITE, Ready, SocketWatch
from shared.config.impairment import HELD, Direction, Impairer

PENDING_MAX: Final = 262_144
"""Maximum due bytes that wait for a slow receiver. Above it, the proxy stops reading from the
sender, which then blocks as on a direct link.
"""
WAITING_MAX: Final = 4_194_304
"""Maximum bytes that are not due yet, 10 s of states. Above it, the proxy stops reading from the
sender."""
_READ: Final = 65_536
_LENGTH: Final = struct.Struct("<H")
_ID: Final = 0x1F  # low five bits of every header
_EXTENDED: Final = 0x80  # header bit: extensions follow
_FRAME: Final = 0x05
_PUSH: Final = 0x1D
_ENCODING: Final = 0x60  # extension bits: unit, number or bytes
_NUMBER: Final = 0x20
_BYTES: Final = 0x40


class Splitter:
    """Splits a stream into batches."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the batches that `data` completes, each with its length prefix."""
        data = self._rest + data
        begin, batches = 0, []
        while begin + 2 <= len(data):
            end = begin + 2 + _LENGTH.unpack_from(data, begin)[0]
            if end > len(data):
                break
            batches.append(data[begin:end])
            begin = end
        self._rest = data[begin:]
        return batches


def carries_messages(batch: bytes) -> bool:
    """Return True for a batch of application messages, which may be lost.

    Returns False for a batch that cannot be parsed, which is therefore never lost.
    """
    try:
        if batch[2] & _ID != _FRAME:
            return False
        _, at = _number(batch, 3)
        if batch[2] & _EXTENDED:
            at = _after_extensions(batch, at)
        return batch[at] & _ID == _PUSH
    except IndexError:
        return False


def _number(batch: bytes, at: int) -> tuple[int, int]:
    """Decode seven bits per byte, least significant first; return the number and the next index."""
    value, shift = 0, 0
    while True:
        byte = batch[at]
        value, shift, at = value | (byte & 0x7F) << shift, shift + 7, at + 1
        if not byte & 0x80:
            return value, at


def _after_extensions(batch: bytes, at: int) -> int:
    more = True
    while more:
        header = batch[at]
        at, more = at + 1, bool(header & _EXTENDED)
        if header & _ENCODING == _NUMBER:
            _, at = _number(batch, at)
        elif header & _ENCODING == _BYTES:
            length, at = _number(batch, at)
            at += length
    return at


class Waiting(NamedTuple):
    """A batch that waits to be forwarded."""

    release_ns: int
    batch: bytes
    """Empty for the end of the stream, which is delayed like a batch."""
    counted: Impairer | None = None
    """Impairer that counted the batch as passed; None without one, or for a duplicate."""

    def count_lost(self) -> None:
        """Count the batch as lost instead of passed, because its connection is closed."""
        if self.counted is not None:
            self.counted.drop()


class Flow:
    """Reads batches from one end, and writes each to the other end when due, without blocking."""

    def __init__(self, source: socket.socket, sink: socket.socket, direction: Direction) -> None:
        self.source, self.sink, self.direction = source, sink, direction
        self.ended = False
        """True once the source has ended."""
        self.broken = False
        """True once the sink has failed; the source is still read, to see its end."""
        self._closing = False
        self._splitter = Splitter()
        self._held: list[Waiting] = []
        self._waits = 0
        self._pending = bytearray()
        self._unsent: deque[tuple[int, Waiting]] = deque()
        self._sent = 0
        self._since_ns: int | None = None
        self._own_ns = 0
        """Release time of the newest batch of the link's own traffic."""
        self._stream_ns = 0
        """Release time of the last batch that nothing may overtake."""

    @property
    def writes(self) -> bool:
        """True while bytes wait for the sink."""
        return bool(self._pending)

    @property
    def reads(self) -> bool:
        """True while the source is open and not too much waits for the sink."""
        return not self.ended and len(self._pending) < PENDING_MAX and self._waits < WAITING_MAX

    @property
    def over(self) -> bool:
        """True once the end of the stream is due and everything before it is written."""
        return self._closing and not self._pending

    def read(self, now_ns: int) -> list[Waiting]:
        """Read the available data; return the batches to release, in order of arrival."""
        found = self.release(now_ns)
        try:
            data = self.source.recv(_READ)
        except BlockingIOError:
            return found
        except OSError:
            data = b""
        if not data:
            self.ended = True
            return found + self._keep([Waiting(self._later(now_ns), b"")])
        rows = []
        for batch in self._splitter.feed(data):
            if carries_messages(batch):
                rows += self._message(now_ns, batch)
            else:
                rows.append(Waiting(self._later(now_ns), batch))
        return found + self._keep(rows)

    def release(self, now_ns: int) -> list[Waiting]:
        """Return the batches held back by a partition that has ended, delayed like new ones."""
        impairer = self.direction.active
        if not self._held or (impairer is not None and impairer.what.partition):
            return []
        found, self._held = self._held, []
        return [self._resumed(row, now_ns) for row in found]

    def put(self, row: Waiting) -> None:
        """Write a due batch, and queue the part that the sink does not accept."""
        self._waits -= len(row.batch)
        if self.broken:
            row.count_lost()
        if not row.batch:
            self._closing = True
        elif self._pending:
            self._queue(row, row.batch)
        elif not self.broken:
            self._send(row)

    def flush(self) -> None:
        """Write as much of the queue as the sink accepts."""
        try:
            sent = self.sink.send(self._pending)
        except BlockingIOError:
            return
        except OSError:
            self._break()
            return
        del self._pending[:sent]
        self._sent += sent
        self._since_ns = None
        while self._unsent and self._unsent[0][0] <= self._sent:
            self._unsent.popleft()

    def stuck_ns(self, now_ns: int) -> int:
        """Return the time for which the sink has accepted none of the waiting bytes.

        Each call tries to write, because a UNIX socket is not reported as writable before most of
        its buffer is read. The time counts from the first call that finds bytes waiting.
        """
        if self._pending:
            self.flush()
        if not self._pending:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = now_ns
        return 0 if self._since_ns is None else now_ns - self._since_ns

    def drop(self) -> None:
        """Count held and unsent messages as lost, because the connection is closed."""
        self._break()
        for row in self._held:
            row.count_lost()
        self._held.clear()

    def _break(self) -> None:
        self.broken = True
        for _, row in self._unsent:
            row.count_lost()
        self._unsent.clear()
        self._pending.clear()

    def _queue(self, row: Waiting, rest: bytes) -> None:
        self._pending += rest
        self._unsent.append((self._sent + len(self._pending), row))

    def _send(self, row: Waiting) -> None:
        try:
            sent = self.sink.send(row.batch)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._break()
            row.count_lost()
            return
        if sent < len(row.batch):
            self._queue(row, row.batch[sent:])

    def _keep(self, rows: list[Waiting]) -> list[Waiting]:
        """Store the batches that a partition holds back; return the others."""
        found: list[Waiting] = []
        for row in rows:
            self._waits += len(row.batch)
            (self._held if row.release_ns == HELD else found).append(row)
        return found

    def _message(self, now_ns: int, batch: bytes) -> list[Waiting]:
        """Return a row for each copy of a message; only the first copy is counted."""
        impairer = self.direction.active
        times = sorted(self._not_before(t) for t in self.direction.passes(now_ns, len(batch)))
        return [Waiting(t, batch, None if n else impairer) for n, t in enumerate(times)]

    def _resumed(self, row: Waiting, now_ns: int) -> Waiting:
        release_ns = self._later(now_ns)
        if row.counted is not None:  # a held message, which is always on a stream
            self._stream_ns = release_ns
        return row._replace(release_ns=release_ns)

    def _later(self, now_ns: int) -> int:
        """Return the release time of a batch that must be neither lost nor reordered."""
        impairer = self.direction.active
        release_ns = now_ns if impairer is None else impairer.delays(now_ns)
        if release_ns != HELD:
            release_ns = self._own_ns = max(release_ns, self._own_ns, self._stream_ns)
            if impairer is not None and impairer.what.ordered:
                self._stream_ns = release_ns
        return release_ns

    def _not_before(self, release_ns: int) -> int:
        """Return a message's release time, not before that of an earlier message on the stream.

        This also applies after an impairment ends: the messages that it delayed come first.
        """
        if release_ns == HELD:
            return HELD
        release_ns = max(release_ns, self._stream_ns)
        impairer = self.direction.active
        if impairer is not None and impairer.what.ordered:
            release_ns = self._stream_ns = max(release_ns, self._own_ns)
        return release_ns


class Connection:
    """Both flows of a connection.

    `ends` are the sockets of the dialling and of the listening process. `directions` are the
    impairments from the first to the second and back. `taken` is called with the batches that a
    flow has read, and the time, ns.
    """

    def __init__(
        self,
        ends: tuple[socket.socket, socket.socket],
        directions: tuple[Direction, Direction],
        watch: SocketWatch,
        taken: Callable[[Connection, Flow, list[Waiting], int], None],
    ) -> None:
        first, second = ends
        there, back = Flow(first, second, directions[0]), Flow(second, first, directions[1])
        self.flows = (there, back)
        self.parted = False
        """True once the connection is closed; its waiting batches are dropped."""
        self._watch, self._taken = watch, taken
        self._ready: tuple[Ready, Ready] = (
            partial(self._is_ready, there, back),
            partial(self._is_ready, back, there),
        )
        self._wanted = (0, 0)
        self.watch_ends()

    @property
    def left(self) -> bool:
        """True if a process has closed its end, even if the other has not seen that yet."""
        return any(flow.ended for flow in self.flows)

    @property
    def over(self) -> bool:
        """True once an end has received everything, or both processes have closed their ends.

        Zenoh closes both directions at once, so an end that has stopped sending receives nothing.
        """
        there, back = self.flows
        return there.over or back.over or (there.ended and back.ended)

    def watch_ends(self) -> None:
        """Watch the ends for the events that the flows need now."""
        there, back = self.flows
        wanted = (
            (READ if there.reads else 0) | (WRITE if back.writes else 0),
            (READ if back.reads else 0) | (WRITE if there.writes else 0),
        )
        if wanted == self._wanted:
            return
        self._wanted = wanted
        for flow, events, ready in zip(self.flows, wanted, self._ready, strict=True):
            self._watch.want(flow.source, events, ready)

    def part(self) -> None:
        """Close both ends; held and unsent messages are lost."""
        self.parted = True
        for flow, ready in zip(self.flows, self._ready, strict=True):
            self._watch.want(flow.source, 0, ready)
            flow.source.close()
            flow.drop()

    def _is_ready(self, source: Flow, sink: Flow, events: int, now_ns: int) -> None:
        """Handle a ready end, from which one flow reads and to which the other writes."""
        if self.parted:
            return  # it was closed earlier in this cycle
        if events & WRITE:
            sink.flush()
        self._taken(self, source, source.read(now_ns) if events & READ else [], now_ns)
