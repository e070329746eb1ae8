"""The USB plugs of the emulated drives: UNIX sockets, one packet per bulk transfer.

A plug is a listening socket whose file name is the drive's serial number; the stand-in for libusb
(`libusb_standin.c`) is the other end. `FibreHub` is all plugs of one simulator; it polls them
together.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from services.simulator.fronts.fibre_front import FibreFront
from services.simulator.fronts.unix_can_hub import accept, listen

PACKET_BYTES: Final = 64
"""A full-speed bulk transfer."""
CHECK_EVERY: Final = 8
"""Polls from one check of the plugs to the next: new clients, boards that went silent."""

_PACKETS = 64  # a client that floods the link must not hold up the simulator


class FibrePort:
    """The USB plug of one board.

    While the board does not respond (`AxisBank.is_responding`: no power, booting, cable pulled)
    the plug is out: every client loses the drive, and finds it again when it is back.

    Raises:
        FleetError: the path cannot be listened on.
    """

    def __init__(self, front: FibreFront, path: Path) -> None:
        self.path = path
        self.front = front
        self.clients: dict[int, socket.socket] = {}
        """Processes that see this drive, by descriptor."""
        self.listener: socket.socket | None = None
        """None while the plug is out."""
        self.plug()

    @property
    def right(self) -> bool:
        """True if the plug is in while the board talks, and out while it does not."""
        return self.front.board.is_responding == (self.listener is not None)

    def plug(self) -> None:
        """Put the plug in; clients find the drive when they next look."""
        self.listener = listen(self.path, "USB port")

    def unplug(self) -> None:
        """Pull the plug: every client loses the drive at once."""
        if self.listener is None:
            return
        self.path.unlink(missing_ok=True)
        self.listener.close()
        self.listener = None
        for client in self.clients.values():
            client.close()
        self.clients.clear()

    def serve(self, client: socket.socket) -> bool:
        """Answer the client's packets that have arrived; return False if the client is gone."""
        answer = self.front.answer
        try:
            for _ in range(_PACKETS):
                packet = client.recv(PACKET_BYTES)
                if not packet:
                    return False
                reply = answer(packet)
                if reply is not None:
                    client.send(reply)
        except BlockingIOError:
            pass  # all is answered; or it does not read, and loses its answers as on a real bus
        except OSError:
            return False
        return True


class FibreHub:
    """All USB plugs of one simulator.

    Without a client a poll costs nearly nothing: the plugs have waited for longer.
    """

    def __init__(self, ports: Sequence[FibrePort]) -> None:
        self.ports = tuple(ports)
        self._epoll = select.epoll()
        self._polls = 0
        for port in self.ports:
            self._watch(port.listener)

    @property
    def clients(self) -> int:
        """How many connections there are, over all drives."""
        return sum(len(port.clients) for port in self.ports)

    def fileno(self) -> int:
        """Return the descriptor that is readable when there is something for `poll`."""
        return self._epoll.fileno()

    def poll(self) -> None:
        """Answer all requests that have come; now and then look at the plugs. Never waits."""
        self._polls += 1
        if self._polls % CHECK_EVERY == 0:
            for port in self.ports:
                self._turn_if_wrong(port)
        elif not self.clients:
            return
        for descriptor, _event in self._epoll.poll(0):
            for port in self.ports:
                if descriptor in port.clients:
                    self._serve(port, descriptor)
                elif port.listener is not None and port.listener.fileno() == descriptor:
                    self._admit(port, port.listener)

    def close(self) -> None:
        """Pull all plugs for good."""
        for port in self.ports:
            port.unplug()
        self._epoll.close()

    def _watch(self, end: socket.socket | None) -> None:
        if end is not None:
            self._epoll.register(end, select.EPOLLIN)

    def _turn_if_wrong(self, port: FibrePort) -> bool:
        """Put a plug in or pull it, as its board has it; return True if that was to be done."""
        if port.right:
            return False
        if port.listener is None:
            port.plug()
            self._watch(port.listener)
        else:
            port.unplug()  # a closed socket leaves the epoll by itself
        return True

    def _admit(self, port: FibrePort, listener: socket.socket) -> None:
        """Admit a client where one has come."""
        client = accept(listener)
        if client is not None:
            port.clients[client.fileno()] = client
            self._watch(client)

    def _serve(self, port: FibrePort, descriptor: int) -> None:
        """Answer a client; a board that has gone silent answers nothing more."""
        if not self._turn_if_wrong(port) and not port.serve(port.clients[descriptor]):
            port.clients.pop(descriptor).close()
