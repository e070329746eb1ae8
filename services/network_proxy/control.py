"""The network proxy's socket: requests in, answers out. Never waits for anybody."""

from __future__ import annotations

import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from services.network_proxy.event_loop import READ, WRITE, SocketWatch
from services.network_proxy.listener import SocketListener
from shared.network.proxy_protocol import LINE_MAX, Reply, Request

ASKERS_MAX: Final = 16
"""Who asks at once; one more, and the one that came first has to go."""
_decode = msgspec.json.Decoder(Request).decode


class _Asker:
    """A client: the rest of its next request, and of the last reply."""

    def __init__(self, end: socket.socket) -> None:
        self.end = end
        self.half = bytearray()
        self.answer = bytearray()
        self.gone = False

    def read(self) -> None:
        try:
            data = self.end.recv(LINE_MAX)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        self.half += data
        self.gone = not data or (len(self.half) > LINE_MAX and b"\n" not in self.half)

    def next_line(self) -> bytes | None:
        """Return the next request; None: none is whole, or the last answer has not gone yet."""
        at = self.half.find(b"\n")
        if at < 0 or self.answer:
            return None
        line = bytes(self.half[:at])
        del self.half[: at + 1]
        return line

    def write(self) -> None:
        try:
            sent = self.end.send(self.answer)
        except BlockingIOError:
            return
        except OSError:  # it did not wait for its answer
            self.gone = True
            self.half.clear()
            self.answer.clear()
            return
        del self.answer[:sent]


class ControlSocket:
    """A UNIX socket that takes one request a line."""

    def __init__(self, path: Path, obey: Callable[[Request], Reply], watch: SocketWatch) -> None:
        """Listen.

        Args:
            path: of the socket; the file of a killed network proxy is removed.
            obey: carries a request out.
            watch: of the loop.

        Raises:
            BusError: no socket can be made there.
        """
        self._obey, self._watch = obey, watch
        self._askers: list[_Asker] = []
        self._listener = SocketListener(path)
        watch.want(self._listener.socket, READ, self._dialled)

    def close(self) -> None:
        """Listen no more."""
        for asker in list(self._askers):
            self._leave(asker)
        self._watch.want(self._listener.socket, 0, self._dialled)
        self._listener.close()

    def _dialled(self, _events: int, _now_ns: int) -> None:
        end = self._listener.accept()
        if end is None:
            return
        if len(self._askers) >= ASKERS_MAX:
            self._leave(self._askers[0])
        self._askers.append(_Asker(end))
        self._watch.want(end, READ, partial(self._is_ready, self._askers[-1]))

    def _is_ready(self, asker: _Asker, events: int, _now_ns: int) -> None:
        """Go on with one: the answer first, and then the next request."""
        if asker not in self._askers:
            return  # it went in this same turn
        if events & WRITE:
            asker.write()
        if events & READ:
            asker.read()
        while (line := asker.next_line()) is not None:
            asker.answer += msgspec.json.encode(self._answer(line)) + b"\n"
            asker.write()
        if asker.gone and not asker.answer:
            self._leave(asker)
        else:
            ready = partial(self._is_ready, asker)
            self._watch.want(asker.end, WRITE if asker.answer else READ, ready)

    def _leave(self, asker: _Asker) -> None:
        self._askers.remove(asker)
        self._watch.want(asker.end, 0, partial(self._is_ready, asker))
        asker.end.close()

    def _answer(self, line: bytes) -> Reply:
        try:
            return self._obey(_decode(line))
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            return Reply(error=f"not understood: {error}")
