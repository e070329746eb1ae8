"""One connection of a pair: two ends, and a flow each way."""

from __future__ import annotations

import socket
from collections.abc import Callable
from functools import partial

from services.network_proxy.direction import Flow, Waiting
from services.network_proxy.event_loop import READ, WRITE, Ready, SocketWatch
from shared.config.impairment import Direction


class Connection:
    """Both flows, and when there is nobody left for them."""

    def __init__(
        self,
        ends: tuple[socket.socket, socket.socket],
        directions: tuple[Direction, Direction],
        watch: SocketWatch,
        taken: Callable[[Connection, Flow, list[Waiting], int], None],
    ) -> None:
        """Start to watch both ends.

        Args:
            ends: sockets of the dialling side and of the other; they do not block.
            directions: from the first to the second, and back.
            watch: of the loop.
            taken: called with what a flow has read, and the time, ns.
        """
        first, second = ends
        there, back = Flow(first, second, directions[0]), Flow(second, first, directions[1])
        self.flows = (there, back)
        self.parted = False
        """Closed; what waits for it is dropped."""
        self._watch, self._taken = watch, taken
        self._ready: tuple[Ready, Ready] = (
            partial(self._is_ready, there, back),
            partial(self._is_ready, back, there),
        )
        self._wanted = (0, 0)
        self.look()

    @property
    def left(self) -> bool:
        """True if a process has left it, though the other may not have seen it yet."""
        return any(flow.ended for flow in self.flows)

    @property
    def over(self) -> bool:
        """True once an end has received everything, or both have left: nobody receives the rest.

        Zenoh closes both ways at once: an end that sends no more does not receive either.
        """
        there, back = self.flows
        return there.over or back.over or (there.ended and back.ended)

    def look(self) -> None:
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
        """Close both ends; held messages are lost."""
        self.parted = True
        for flow, ready in zip(self.flows, self._ready, strict=True):
            self._watch.want(flow.source, 0, ready)
            flow.source.close()
            flow.drop()

    def _is_ready(self, source: Flow, sink: Flow, events: int, now_ns: int) -> None:
        """Continue at an end: one flow reads there, the other writes."""
        if self.parted:
            return  # in this same turn
        if events & WRITE:
            sink.flush()
        self._taken(self, source, source.take(now_ns) if events & READ else [], now_ns)
