"""The USB ports of the emulated drives: UNIX sockets, one packet per bulk transfer.

A port is a listening socket whose file name is the drive's serial number. The stand-in for libusb
(`libusb_standin.c`) connects to it. `FibreHub` polls all ports of one simulator.
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
"""Maximum bytes of a full-speed bulk packet."""
CHECK_EVERY: Final = 8
"""Polls between two checks of the ports for new clients and silent boards."""

_PACKETS = 64  # a client that floods the link must not delay the simulator


class FibrePort:
    """The USB port of one board.

    While the board does not respond (`AxisBank.is_responding`: no power, booting, unplugged) the
    port is closed. Every client then loses the drive, and finds it again when it returns.

    Raises:
        FleetError: listening on the path fails.
    """

    def __init__(self, front: FibreFront, path: Path) -> None:
        self.path = path
        self.front = front
        self.clients: dict[int, socket.socket] = {}
        """Connections of clients, by descriptor."""
        self.listener: socket.socket | None = None
        """None while the port is closed."""
        self.plug()

    @property
    def right(self) -> bool:
        """True if the port matches the board: open while the board responds, else closed."""
        return self.front.board.is_responding == (self.listener is not None)

    def plug(self) -> None:
        """Open the port; clients find the drive at their next scan."""
        self.listener = listen(self.path, "USB port")

    def unplug(self) -> None:
        """Close the port; every client loses the drive at once."""
        if self.listener is None:
            return
        self.path.unlink(missing_ok=True)
        self.listener.close()
        self.listener = None
        for client in self.clients.values():
            client.close()
        self.clients.clear()

    def serve(self, client: socket.socket) -> bool:
        """Answer the packets received from a client; return False if it has disconnected."""
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
            pass  # all are answered, or the client reads too slowly and loses answers as on USB
        except OSError:
            return False
        return True


class FibreHub:
    """All USB ports of one simulator.

    Without a client a poll costs almost nothing, because the ports are checked only every
    `CHECK_EVERY` polls.
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
        """Answer all received requests, and check the ports periodically, without waiting."""
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
        """Close all ports for good."""
        for port in self.ports:
            port.unplug()
        self._epoll.close()

    def _watch(self, end: socket.socket | None) -> None:
        if end is not None:
            self._epoll.register(end, select.EPOLLIN)

    def _turn_if_wrong(self, port: FibrePort) -> bool:
        """Open or close a port to match its board; return True if it did not match."""
        if port.right:
            return False
        if port.listener is None:
            port.plug()
            self._watch(port.listener)
        else:
            port.unplug()  # a closed socket leaves the epoll on its own
        return True

    def _admit(self, port: FibrePort, listener: socket.socket) -> None:
        client = accept(listener)
        if client is not None:
            port.clients[client.fileno()] = client
            self._watch(client)

    def _serve(self, port: FibrePort, descriptor: int) -> None:
        """Answer a client, unless its board is silent."""
        if not self._turn_if_wrong(port) and not port.serve(port.clients[descriptor]):
            port.clients.pop(descriptor).close()
