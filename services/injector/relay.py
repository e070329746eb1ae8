"""Stands between the ends of links, and lets their batches through when they are due."""

from __future__ import annotations

import contextlib
import errno
import heapq
import socket
from collections.abc import Mapping
from itertools import count
from typing import NamedTuple

from services.injector.flow import Flow
from shared.impairment import HELD, Direction
from shared.links import Pair


class Place(NamedTuple):
    """Where one pair of processes is linked through."""

    pair: Pair
    listener: socket.socket
    """Where the one that dials comes to; it does not block."""
    address: str | tuple[str, int]
    """Where the other one listens: path of a UNIX socket, or host and port."""


class Relay:
    """Every connection, and every batch that waits."""

    def __init__(self, places: list[Place], directions: Mapping[str, Direction]) -> None:
        """Take what to listen on.

        Args:
            places: one for each pair.
            directions: what is done to each direction, by name; others pass at once.
        """
        self._places = {place.listener: place for place in places}
        self._directions = directions
        self._flows: dict[socket.socket, Flow] = {}
        self._by_sink: dict[socket.socket, Flow] = {}
        self._due: list[tuple[int, int, Flow, bytes]] = []
        self._held: list[tuple[Flow, bytes]] = []
        self._full: set[socket.socket] = set()
        """Ends that had no room."""
        self._ends: list[socket.socket] = list(self._places)
        """Every socket that can be read; made anew when one comes or goes."""
        self._count = count()
        self.refused = 0
        """Connections to a process that was not there."""

    def readers(self) -> list[socket.socket]:
        """Return the sockets to wait for."""
        if not self._full:
            return self._ends
        return [end for end in self._ends if end in self._places or self._flows[end].reads]

    def writers(self) -> list[socket.socket]:
        """Return the sockets that are to take more."""
        return list(self._full)

    def next_ns(self) -> int | None:
        """Return when the next batch is due; None: none waits."""
        return self._due[0][0] if self._due else None

    def readable(self, end: socket.socket, now_ns: int) -> None:
        """Take in what has come on a socket."""
        place = self._places.get(end)
        if place is not None:
            self._link(place)
            return
        flow = self._flows.get(end)
        if flow is None:
            return  # closed in this same round
        for release_ns, batch in flow.take(now_ns):
            if release_ns == HELD:
                self._held.append((flow, batch))
            elif release_ns <= now_ns:
                self._let_out(flow, batch)
            else:
                heapq.heappush(self._due, (release_ns, next(self._count), flow, batch))
        if flow.ended:
            self._list_ends()

    def writable(self, end: socket.socket) -> None:
        """Go on with what a socket had no room for."""
        flow = self._by_sink.get(end)
        if flow is not None:
            flow.flush()
            self._look_at(flow)

    def let_out_due(self, now_ns: int) -> None:
        """Let out every batch whose time has come."""
        while self._due and self._due[0][0] <= now_ns:
            _, _, flow, batch = heapq.heappop(self._due)
            self._let_out(flow, batch)

    def release(self) -> None:
        """Let out what partitions that are over have held back."""
        held, self._held = self._held, []
        for flow, batch in held:
            impairer = flow.direction.in_force
            if impairer is not None and impairer.what.partition:
                self._held.append((flow, batch))
            else:
                self._let_out(flow, batch)

    def close(self) -> None:
        """End every connection, and listen no more."""
        for end in (*self._flows, *self._places):
            end.close()
        self._flows.clear()
        self._by_sink.clear()

    def _link(self, place: Place) -> None:
        """Accept a connection and make the one beyond."""
        try:
            dialling, _ = place.listener.accept()
        except OSError:
            return
        unix = isinstance(place.address, str)
        beyond = socket.socket(socket.AF_UNIX if unix else socket.AF_INET)
        beyond.setblocking(False)
        if beyond.connect_ex(place.address) not in (0, errno.EINPROGRESS):
            self.refused += 1  # the one that dials sees the end of its own, and tries again
            dialling.close()
            beyond.close()
            return
        for end in (dialling, beyond):
            end.setblocking(False)
            if not unix:
                with contextlib.suppress(OSError):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for source, sink, name in (
            (dialling, beyond, place.pair.there),
            (beyond, dialling, place.pair.back),
        ):
            direction = self._directions.get(name) or Direction(name, 0)
            flow = Flow(source, sink, direction)
            self._flows[source] = self._by_sink[sink] = flow
        self._list_ends()

    def _list_ends(self) -> None:
        self._ends = [*self._places, *(end for end, flow in self._flows.items() if not flow.ended)]

    def _let_out(self, flow: Flow, batch: bytes) -> None:
        if flow.source not in self._flows:
            return  # its connection is gone
        if not batch:
            self._part(flow)
            return
        flow.put(batch)
        self._look_at(flow)

    def _look_at(self, flow: Flow) -> None:
        """See whether what was written has gone."""
        if flow.broken:
            self._part(flow)
        elif flow.writes:
            self._full.add(flow.sink)
        else:
            self._full.discard(flow.sink)

    def _part(self, flow: Flow) -> None:
        """Close a connection, both ends of it."""
        for end in (flow.source, flow.sink):
            self._flows.pop(end, None)
            self._by_sink.pop(end, None)
            self._full.discard(end)
            end.close()
        self._list_ends()
        self._held = [row for row in self._held if row[0].source in self._flows]
