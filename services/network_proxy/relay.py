"""Relay between the ends of links: forwards each batch when it is due."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import count
from typing import Final, NamedTuple

from services.network_proxy.connection import Connection, Flow, Waiting
from services.network_proxy.sockets import READ, ProxyEndpoint, SocketWatch
from shared.config.impairment import Direction

LINKS_MAX: Final = 16
"""Maximum number of connections per pair. In a partition, a live process redials about every
second, and a stopped process closes no connection. At the maximum, a new connection replaces the
oldest one that a process has closed, or else the oldest one."""


class _Due(NamedTuple):
    """A batch that waits for its release; batches for the same time go in order of arrival."""

    release_ns: int
    number: int
    connection: Connection
    flow: Flow
    row: Waiting


class Relay:
    """Keeps all connections, and the batches that are not due yet."""

    def __init__(
        self,
        endpoints: Sequence[ProxyEndpoint],
        directions: Mapping[str, Direction],
        watch: SocketWatch,
        lease_ns: int,
    ) -> None:
        """Start listening.

        `directions` are the directions that can be impaired, by name; all others forward at once.
        Zenoh gives up a link that is silent for `lease_ns`.
        """
        self._directions, self._watch, self._lease_ns = directions, watch, lease_ns
        self._links: dict[ProxyEndpoint, list[Connection]] = {
            endpoint: [] for endpoint in endpoints
        }
        self._due: list[_Due] = []
        self._looks_ns = 0
        self._count = count()
        self.stuck = 0
        """Number of connections closed because an end no longer accepted data."""
        for endpoint in endpoints:
            watch.want(endpoint.listener.socket, READ, partial(self._dialled, endpoint))

    @property
    def links(self) -> int:
        """Number of open connections."""
        return sum(map(len, self._links.values()))

    @property
    def refused(self) -> int:
        """Number of connections refused: the other process or a free descriptor was missing."""
        return sum(endpoint.missing + endpoint.listener.turned_away for endpoint in self._links)

    def next_ns(self) -> int | None:
        """Return the time at which the next batch is due, ns; None if no batch waits."""
        return self._due[0].release_ns if self._due else None

    def release_due(self, now_ns: int) -> None:
        """Forward every batch that is due."""
        while self._due and self._due[0].release_ns <= now_ns:
            due = heapq.heappop(self._due)
            due.flow.put(due.row)
            self._settle(due.connection)

    def release_held(self, now_ns: int) -> None:
        """Forward the batches held back by partitions that have ended."""
        for links in list(self._links.values()):
            for connection in list(links):
                for flow in connection.flows:
                    self._pass_on(connection, flow, flow.release(now_ns), now_ns)

    def part_stuck(self, now_ns: int) -> None:
        """Close every connection with an end that has accepted no data for `lease_ns`.

        Both processes may have given up the link without closing it: each waits for buffer space to
        announce this, and no longer reads. Nothing else would resolve this deadlock.
        """
        if now_ns < self._looks_ns:
            return
        self._looks_ns = now_ns + self._lease_ns // 8
        for links in self._links.values():
            for connection in list(links):
                if max(flow.stuck_ns(now_ns) for flow in connection.flows) > self._lease_ns:
                    self.stuck += 1
                    self._part(connection)
                else:
                    self._settle(connection)

    def close(self) -> None:
        """Close every connection, and stop listening."""
        for endpoint, links in self._links.items():
            for connection in list(links):
                self._part(connection)
            endpoint.listener.close()

    def _dialled(self, endpoint: ProxyEndpoint, _events: int, _now_ns: int) -> None:
        ends = endpoint.link()
        if ends is None:
            return
        links = self._links[endpoint]
        if len(links) >= LINKS_MAX:
            self._part(next((one for one in links if one.left), links[0]))
        there, back = (
            self._directions.get(name) or Direction(name, 0)
            for name in (endpoint.pair.there, endpoint.pair.back)
        )
        links.append(Connection(ends, (there, back), self._watch, self._pass_on))

    def _pass_on(
        self, connection: Connection, flow: Flow, rows: list[Waiting], now_ns: int
    ) -> None:
        """Forward the batches that are due, and queue the others."""
        for row in rows:
            if row.release_ns <= now_ns:
                flow.put(row)
            else:
                due = _Due(row.release_ns, next(self._count), connection, flow, row)
                heapq.heappush(self._due, due)
        self._settle(connection)

    def _settle(self, connection: Connection) -> None:
        if connection.over:
            self._part(connection)
        elif not connection.parted:
            connection.watch_ends()

    def _part(self, connection: Connection) -> None:
        """Close a connection; its waiting batches are lost."""
        if connection.parted:
            return
        connection.part()
        for links in self._links.values():
            if connection in links:
                links.remove(connection)
        for due in self._due:
            if due.connection is connection:
                due.row.count_lost()
        self._due = [due for due in self._due if due.connection is not connection]
        heapq.heapify(self._due)
