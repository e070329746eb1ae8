"""Sockets of the network proxy: waiting, listening and dialling."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import selectors
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

from shared.config.endpoints import host_and_port
from shared.exceptions import BusError
from shared.links import Pair
from shared.run_directory import private_files

READ: Final = selectors.EVENT_READ
WRITE: Final = selectors.EVENT_WRITE

Ready: TypeAlias = Callable[[int, int], None]
"""Called with a socket's readiness (READ, WRITE) and the time, ns."""


class SocketWatch:
    """Watch on the loop's sockets, without the descriptor limit of `select`."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._wanted: dict[socket.socket, int] = {}

    def want(self, end: socket.socket, events: int, ready: Ready) -> None:
        """Watch an open socket for exactly `events` from now on; 0 ends the watch."""
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
        """Wait until a socket is ready, at most `patience_s`; return callbacks and readiness.

        The selector would round the time up to a whole millisecond, longer than some requested
        delays. So `select` waits for the selector's epoll descriptor.
        """
        if not select.select([self._selector], [], [], patience_s)[0]:
            return []
        return [(key.data, events) for key, events in self._selector.select(0)]

    def close(self) -> None:
        """Stop watching."""
        self._wanted.clear()
        self._selector.close()


class SocketListener:
    """Listens on a UNIX socket and accepts without blocking, even without a free descriptor.

    It replaces the socket file that a killed process left behind.
    """

    def __init__(self, path: Path) -> None:
        """Listen on a path; raise BusError if the socket cannot be created."""
        self.turned_away = 0
        """Number of connections refused for lack of a descriptor."""
        self._path = path
        self.socket = socket.socket(socket.AF_UNIX)
        try:
            path.unlink(missing_ok=True)
            with private_files():
                self.socket.bind(str(path))
            self.socket.listen()
        except OSError as error:
            self.socket.close()
            text = f"{path}: {error.strerror or error}; choose another --run-dir"
            raise BusError(text) from None
        self.socket.setblocking(False)
        self._spare: int | None = None
        self._keep_spare()

    def accept(self) -> socket.socket | None:
        """Return the socket of a new client, or None if no client waits or it was refused."""
        try:
            end, _ = self.socket.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._turn_away()
            return None
        end.setblocking(False)
        return end

    def close(self) -> None:
        """Stop listening, and remove the path."""
        self.socket.close()
        self._path.unlink(missing_ok=True)
        self._give_spare()

    def _turn_away(self) -> None:
        """Refuse a client, using the spare descriptor.

        A client left in the queue keeps the socket readable, so the loop would never wait.
        """
        self.turned_away += 1
        self._give_spare()
        with contextlib.suppress(OSError):
            self.socket.accept()[0].close()
        self._keep_spare()

    def _keep_spare(self) -> None:
        with contextlib.suppress(OSError):
            self._spare = os.open(os.devnull, os.O_RDONLY)

    def _give_spare(self) -> None:
        if self._spare is not None:
            os.close(self._spare)
            self._spare = None


class Address(NamedTuple):
    """A resolved endpoint of a process: dialling it needs no name lookup."""

    family: socket.AddressFamily
    where: Any
    """Address to connect to: a path, or a numeric host with its port."""


class ProxyEndpoint:
    """Endpoint between the processes of a pair: one process dials it, and it dials the other."""

    def __init__(self, pair: Pair, listener: SocketListener, beyond: Address) -> None:
        self.pair, self.listener = pair, listener
        self.missing = 0
        """Number of connections closed because the other process could not be dialled."""
        self._beyond = beyond

    def link(self) -> tuple[socket.socket, socket.socket] | None:
        """Accept a client and dial the other process; return both ends, which do not block.

        Returns None if no client waits, or if the other process cannot be dialled; the client's
        connection is then closed, and the client retries.
        """
        dialling = self.listener.accept()
        if dialling is None:
            return None
        try:
            return dialling, self._dial()
        except OSError:
            self.missing += 1
            dialling.close()
            return None

    def _dial(self) -> socket.socket:
        beyond = socket.socket(self._beyond.family)
        try:
            beyond.setblocking(False)
            failed = beyond.connect_ex(self._beyond.where)
            if failed not in (0, errno.EINPROGRESS):
                raise OSError(failed, os.strerror(failed))
            if self._beyond.family != socket.AF_UNIX:
                beyond.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError:
            beyond.close()
            raise
        return beyond


def address_of(endpoint: str) -> Address:
    """Resolve an endpoint; raise BusError unless it is a UNIX socket or a resolvable TCP endpoint.

    Call it only at startup, because a name lookup may block.
    """
    kind, _, rest = endpoint.partition("/")
    if kind == "unixsock-stream":
        return Address(socket.AF_UNIX, rest)
    if kind != "tcp":
        text = "the proxy cannot relay this; use unixsock-stream/PATH or tcp/HOST:PORT"
        raise BusError(f"{endpoint}: {text}")
    host, port = host_and_port(endpoint)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise BusError(f"{endpoint}: {error}; name a host that can be resolved") from None
    family, _, _, _, where = found[0]
    return Address(family, where)
