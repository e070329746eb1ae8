"""The injector's socket: requests in, answers out. Never waits for anybody."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from pathlib import Path

import msgspec

from shared.injection import LINE_MAX, Reply, Request

_decode = msgspec.json.Decoder(Request).decode


class Control:
    """A UNIX socket that takes one request a line."""

    def __init__(self, path: Path, obey: Callable[[Request], Reply]) -> None:
        """Listen.

        Args:
            path: of the socket; what a killed injector left there is removed.
            obey: carries a request out.
        """
        self._obey = obey
        self._path = path
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._listener.setblocking(False)
        self._half: dict[socket.socket, bytes] = {}

    def sockets(self) -> list[socket.socket]:
        """Return the sockets to wait for."""
        return [self._listener, *self._half]

    def readable(self, end: socket.socket) -> bool:
        """Take in what has come; return False if the socket is none of these."""
        if end is self._listener:
            with contextlib.suppress(OSError):
                asker, _ = self._listener.accept()
                asker.setblocking(False)
                self._half[asker] = b""
            return True
        if end not in self._half:
            return False
        try:
            data = end.recv(LINE_MAX)
        except BlockingIOError:
            return True
        except OSError:
            data = b""
        *lines, rest = (self._half[end] + data).split(b"\n")
        for line in lines:
            with contextlib.suppress(OSError):  # it did not wait for its answer
                end.sendall(msgspec.json.encode(self._answer(line)) + b"\n")
        self._half[end] = rest
        if not data or len(rest) > LINE_MAX:
            del self._half[end]
            end.close()
        return True

    def close(self) -> None:
        """Listen no more."""
        for end in self.sockets():
            end.close()
        self._half.clear()
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()

    def _answer(self, line: bytes) -> Reply:
        try:
            return self._obey(_decode(line))
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            return Reply(error=f"not understood: {error}")
