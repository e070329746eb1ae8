"""Where the network proxy stands: one process of a pair dials it, and it dials the other."""

from __future__ import annotations

import errno
import os
import socket
from typing import Any, NamedTuple

from services.network_proxy.listener import SocketListener
from shared.config.endpoints import host_and_port
from shared.exceptions import BusError
from shared.links import Pair


class Address(NamedTuple):
    """A resolved endpoint of a process: dialling it needs no name lookup."""

    family: socket.AddressFamily
    where: Any
    """What sockets of the family connect to: a path, or a numeric host with its port."""


class ProxyEndpoint:
    """Between the two processes of a pair."""

    def __init__(self, pair: Pair, listener: SocketListener, beyond: Address) -> None:
        """Take where the one dials to, and where the other one listens."""
        self.pair, self.listener = pair, listener
        self.missing = 0
        """Connections to a process that was not there."""
        self._beyond = beyond

    def link(self) -> tuple[socket.socket, socket.socket] | None:
        """Accept who dials, and dial the other; return both ends, which do not block.

        None: not both are there. Who dialled sees the end of its connection and tries again.
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
    """Resolve a Zenoh endpoint. A name lookup may block: at the start only.

    Raises:
        BusError: the endpoint is neither a UNIX socket nor TCP, or the host is unknown.
    """
    kind, _, rest = endpoint.partition("/")
    if kind == "unixsock-stream":
        return Address(socket.AF_UNIX, rest)
    if kind != "tcp":
        text = "cannot be stood before; unixsock-stream/PATH or tcp/HOST:PORT can"
        raise BusError(f"{endpoint}: {text}")
    host, port = host_and_port(endpoint)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise BusError(f"{endpoint}: {error}; a host that can be found is needed") from None
    family, _, _, _, where = found[0]
    return Address(family, where)
