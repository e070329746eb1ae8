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
"""Polls between two checks of the plugs for new clients and silent boards."""

_PACKETS = 64  # a client that floods the link must not hold up the simulator


class FibrePort:
    """The USB plug of one board.

    While the board does not respond (`AxisBank.is_responding`: no power, booting, cable pulled)
    the plug is out. Every client then loses the drive, and finds it again when it returns.

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
        """True if the plug matches the board: in while the board responds, else out."""
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
            pass  # all is answered, or the client does not read and loses answers as on a real bus
        except OSError:
            return False
        return True


class FibreHub:
    """All USB plugs of one simulator.

    Without a client a poll costs almost nothing: the plugs are checked every `CHECK_EVERY` polls.
    """

    def __init__(self, ports: Sequence[FibrePort]) -> None:
        self.ports = tuple(ports)
        self._epoll = select.epoll()
        self._polls = 0
        for port in self.ports:
            self._watch(port.listener)

    @property
    def clients(self) -> int:
        """Number of connections, over all drives."""
        return sum(len(port.clients) for port in self.ports)

    def fileno(self) -> int:
        """Return the descriptor that is readable when `poll` has work."""
        return self._epoll.fileno()

    def poll(self) -> None:
        """Answer all received requests, and check the plugs periodically. Never waits."""
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
        """Put a plug in or pull it, to match its board; return True if it did not match."""
        if port.right:
            return False
        if port.listener is None:
            port.plug()
            self._watch(port.listener)
        else:
            port.unplug()  # a closed socket leaves the epoll on its own
        return True

    def _admit(self, port: FibrePort, listener: socket.socket) -> None:
        """Admit a waiting client."""
        client = accept(listener)
        if client is not None:
            port.clients[client.fileno()] = client
            self._watch(client)

    def _serve(self, port: FibrePort, descriptor: int) -> None:
        """Answer a client, unless its board has gone silent."""
        if not self._turn_if_wrong(port) and not port.serve(port.clients[descriptor]):
            port.clients.pop(descriptor).close()
