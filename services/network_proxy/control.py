"""Control of the network proxy: reads requests, executes them and replies, without blocking."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from services.network_proxy.sockets import READ, WRITE, SocketListener, SocketWatch
from shared.clock import NS_PER_S, now_ns
from shared.exceptions import ConfigError
from shared.network.impairment_schedule import ImpairmentSchedule
from shared.network.proxy_protocol import (
    LINE_MAX,
    Begin,
    Clear,
    Reply,
    Request,
    RequestedImpairment,
)
from shared.toml_file import check_ranges

ASKED_MAX: Final = 64
"""Maximum number of impairments; each costs time per message, and adds a row to every reply."""
WAIT_MAX_S: Final = 86_400.0
"""Maximum delay until an impairment starts, s."""


class CommandHandler:
    """Executes requests, or replies with the reason for a refusal."""

    def __init__(self, impairments: ImpairmentSchedule) -> None:
        self._injections = impairments
        self.changed = False
        """True after a request, which may have started or ended an impairment; the loop clears
        it."""

    def obey(self, request: Request) -> Reply:
        """Execute a request; reply with the active and planned impairments, or with an error."""
        at_ns = now_ns()
        try:
            if isinstance(request, Begin):
                if problem := self._problem(request):
                    return Reply(error=problem)
                self._begin(request, at_ns)
            elif isinstance(request, Clear):
                self._injections.clear(request.link, at_ns)
        except ConfigError as error:
            return Reply(error=f"{error.key}: {error.found}; {error.expected}")
        self.changed = True
        return Reply(requested=tuple(self._asked(at_ns)))

    def _problem(self, request: Begin) -> str:
        """Return a reason to refuse, or ""; raise ConfigError for a number out of range."""
        check_ranges("inject", request.inject)
        if not 0.0 <= request.in_s <= WAIT_MAX_S:
            return f"starts in {request.in_s:g} s; must be between 0 and {WAIT_MAX_S:g} s"
        if len(self._injections.requested) >= ASKED_MAX:
            return f"{ASKED_MAX} impairments are active or planned already; clear some first"
        return request.inject.fault()

    def _begin(self, request: Begin, at_ns: int) -> None:
        inject, begins_ns = request.inject, at_ns + request.in_s * NS_PER_S
        lasts_s = math.inf if inject.duration is None else inject.duration
        until_ns = begins_ns + lasts_s * NS_PER_S
        if request.in_s > 0.0:
            self._injections.plan(inject.link, inject, begins_ns, until_ns)
        else:
            self._injections.begin(inject.link, inject, until_ns, at_ns)

    def _asked(self, at_ns: int) -> list[RequestedImpairment]:
        rows = []
        for number, row in self._injections.requested.items():
            passed, lost = self._injections.counts(number)
            left_s = None if math.isinf(row.until) else (row.until - at_ns) / NS_PER_S
            in_s = max(0.0, (row.begins - at_ns) / NS_PER_S)
            hidden = self._injections.hidden(number)
            words = row.what.describe()
            rows.append(
                RequestedImpairment(number, row.link, words, left_s, passed, lost, in_s, hidden)
            )
        return rows


ASKERS_MAX: Final = 16
"""Maximum number of concurrent clients; the oldest is dropped."""
_decode = msgspec.json.Decoder(Request).decode


class _Asker:
    """A client, with the received part of a request and the unsent part of a reply."""

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
        """Return the next request; None if it is incomplete, or the last reply is not sent yet."""
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
        except OSError:  # the client left before its reply
            self.gone = True
            self.half.clear()
            self.answer.clear()
            return
        del self.answer[:sent]


class ControlSocket:
    """UNIX socket that receives requests and sends replies, one per line."""

    def __init__(self, path: Path, obey: Callable[[Request], Reply], watch: SocketWatch) -> None:
        """Listen on a path; raise BusError if the socket cannot be created."""
        self._obey, self._watch = obey, watch
        self._askers: list[_Asker] = []
        self._listener = SocketListener(path)
        watch.want(self._listener.socket, READ, self._dialled)

    def close(self) -> None:
        """Drop all clients, and stop listening."""
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
        """Serve one client: the reply first, then the next request."""
        if asker not in self._askers:
            return  # it was dropped earlier in this cycle
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
            return Reply(error=f"invalid request: {error}")
