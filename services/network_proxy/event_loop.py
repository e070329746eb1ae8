"""Waits for sockets, and says whom to call for each."""

from __future__ import annotations

import select
import selectors
import socket
from collections.abc import Callable
from typing import Final, TypeAlias

READ: Final = selectors.EVENT_READ
WRITE: Final = selectors.EVENT_WRITE

Ready: TypeAlias = Callable[[int, int], None]
"""Called with a socket's readiness (READ, WRITE) and the time, ns."""


class SocketWatch:
    """Every socket of the loop; any number of them, with any descriptors."""

    def __init__(self) -> None:
        """Begin with none."""
        self._selector = selectors.DefaultSelector()
        self._wanted: dict[socket.socket, int] = {}

    def want(self, end: socket.socket, events: int, ready: Ready) -> None:
        """Watch an open socket for `events` from now on, and no other; 0: not any more."""
        watched = self._wanted.get(end, 0)
        if events == watched:
            return
        if not events:
            del self._wanted[end]
            self._selector.unregister(end)
            return
        self._wanted[end] = events
        if watched:
            self._selector.modify(end, events, ready)
        else:
            self._selector.register(end, events, ready)

    def wait(self, patience_s: float) -> list[tuple[Ready, int]]:
        """Wait until a socket is ready; return callbacks and readiness, none after `patience_s`.

        The selector itself would round the patience up to a whole millisecond, longer than some
        requested delays. So its epoll is waited for, as one socket.
        """
        if not select.select([self._selector], [], [], patience_s)[0]:
            return []
        return [(key.data, events) for key, events in self._selector.select(0)]

    def close(self) -> None:
        """Watch none any more."""
        self._wanted.clear()
        self._selector.close()
