"""UNIX datagrams: each key's reader has a socket in the folder, and drains it."""

from __future__ import annotations

import socket
from contextlib import suppress
from pathlib import Path

from tools.lab.bench.transports.base import Put, Take

PAYLOAD_MAX = 65_536


class OverDatagrams:
    """Sockets of one process."""

    def __init__(self, folder: Path) -> None:
        """Take the folder."""
        self._folder = folder
        self._sockets: list[socket.socket] = []

    def publisher(self, key: str) -> Put:
        """See `Transport.publisher`."""
        end, path = self._socket(), self._path(key)

        def put(payload: bytes) -> None:
            with suppress(OSError):  # nobody reads yet, or the reader's socket is full
                end.sendto(payload, socket.MSG_DONTWAIT, path)

        return put

    def latest(self, key: str) -> Take:
        """See `Transport.latest`."""
        end = self._socket()
        end.bind(self._path(key))

        def take() -> bytes | None:
            newest = None
            with suppress(BlockingIOError):
                while True:
                    newest = end.recv(PAYLOAD_MAX, socket.MSG_DONTWAIT)
            return newest

        return take

    def close(self) -> None:
        """Leave."""
        for end in self._sockets:
            end.close()

    def _socket(self) -> socket.socket:
        end = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sockets.append(end)
        return end

    def _path(self, key: str) -> str:
        return str(self._folder / key.replace("/", "."))


def open_transport(_process: str, folder: Path) -> OverDatagrams:
    """Join the sockets in a folder."""
    return OverDatagrams(folder)
