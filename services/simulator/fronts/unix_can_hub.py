"""The bus of `shared.can.unix_can`: a listening UNIX socket that forwards frames."""

from __future__ import annotations

import errno
import fcntl
import os
import select
import socket
import stat
import struct
import termios
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from shared.can.unix_can import PACKET_BYTES, Frame, Interface, pack_frames, unpack_frames
from shared.exceptions import FleetError
from shared.run_directory import private_files

_PATH_BYTES = 107  # sun_path without its terminating zero
_BACKLOG = 16
_ROUNDS = 64  # a client that floods the bus must not delay the simulator
_FRAME_BYTES = 16
_INT = struct.Struct("i")
TXQUEUELEN: Final = 64
"""Maximum frames in an interface's queue, as set by `deploy/udev/92-can.rules`."""


class UnixCanHub:
    """A CAN bus that forwards each client's frames to its owner and to the other clients.

    Raises:
        FleetError: the path is in use, too long, or cannot be created.

    Attributes:
        dropped: packets that were not forwarded because a client's socket was full.
        shared: True if the bus has nodes besides its owner's, which acknowledge frames.
        acknowledged: False while no node acknowledges. Frames then wait in the clients' sockets.
            They reach the bus in order when a node returns, unless the interface restarts first.
        choked: True while other nodes' frames fill the send queue: clients' sends fail with
            ENOBUFS.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dropped = 0
        self.shared = False
        self.acknowledged = True
        self.choked = False
        self._clients: dict[int, socket.socket] = {}
        self._listener = listen(path, "CAN hub")
        self._interface = Interface(path, create=True)
        self._restarts = 0
        self._inode = path.stat().st_ino
        self._epoll = select.epoll()
        self._epoll.register(self._listener, select.EPOLLIN)

    @property
    def clients(self) -> int:
        """Number of clients on the bus."""
        return len(self._clients)

    def poll(self) -> list[Frame]:
        """Return the frames that clients have sent, in order; admit new clients. Never blocks."""
        interface = self._interface
        if self._restarts != interface.restarts:
            self._restarts = interface.restarts
            self._discard()
        if not self.acknowledged:
            self._admit()
            interface.full = self.choked or self._waiting() >= TXQUEUELEN
            return []
        if interface.full != self.choked:
            interface.full = self.choked
        frames: list[Frame] = []
        wait = self._epoll.poll
        for _ in range(_ROUNDS):
            ready = wait(0)
            if not ready:
                break
            for descriptor, _event in ready:
                client = self._clients.get(descriptor)
                if client is None:
                    self._admit()
                else:
                    frames += self._receive(client)
        return frames

    def broadcast(self, frames: Iterable[Frame]) -> None:
        """Send frames to every client in one packet."""
        self.broadcast_packet(pack_frames(frames))

    def broadcast_packet(self, packet: bytes) -> None:
        """Send a packet in the format of `pack_frames` to every client."""
        for client in tuple(self._clients.values()):
            self._send(client, packet)

    def close(self) -> None:
        """Disconnect all clients and remove the socket file, unless another hub has replaced it."""
        if self._epoll.closed:
            return
        self._epoll.close()
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        self._listener.close()
        self._interface.close()
        if self.path.exists() and self.path.stat().st_ino == self._inode:
            self.path.unlink()
            self._interface.path.unlink(missing_ok=True)

    def __enter__(self) -> UnixCanHub:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _admit(self) -> None:
        client = accept(self._listener)
        if client is not None:
            self._clients[client.fileno()] = client
            self._epoll.register(client, select.EPOLLIN)

    def _receive(self, client: socket.socket) -> list[Frame]:
        """Read and forward one packet of a ready client; remove a disconnected client."""
        try:
            packet = client.recv(PACKET_BYTES)
        except BlockingIOError:
            return []
        except ConnectionResetError:
            return []  # reported once if the client left frames unread; its own frames follow
        except OSError:
            packet = b""
        if not packet:
            self._part(client)
            return []
        if len(self._clients) > 1:
            for other in tuple(self._clients.values()):
                if other is not client:
                    self._send(other, packet)
        return unpack_frames(packet)

    def _waiting(self) -> int:
        """Return the number of sent frames that no node has acknowledged."""
        waiting = 0
        for client in self._clients.values():
            (size,) = _INT.unpack(fcntl.ioctl(client, termios.FIONREAD, bytes(_INT.size)))
            waiting += int(size)
        return waiting // _FRAME_BYTES

    def _discard(self) -> None:
        for client in self._clients.values():
            while True:
                try:
                    if not client.recv(PACKET_BYTES):
                        break  # the client has disconnected; `poll` removes it
                except OSError:
                    break

    def _send(self, client: socket.socket, packet: bytes) -> None:
        """Send without waiting; drop packets for which a slow client has no room.

        `_receive` removes a disconnected client after reading its last frames.
        """
        try:
            client.send(packet)
        except BlockingIOError:
            self.dropped += 1
        except OSError:
            pass

    def _part(self, client: socket.socket) -> None:
        if self._clients.pop(client.fileno(), None) is not None:
            self._epoll.unregister(client)
            client.close()


def listen(path: Path, what: str) -> socket.socket:
    """Listen on a path for packets; remove the file of a simulator that has ended.

    Raises:
        FleetError: the path is in use, too long, or cannot be created.
    """
    if len(os.fsencode(path)) > _PATH_BYTES:
        raise FleetError(
            f"{what}: {path} is longer than {_PATH_BYTES} bytes, the maximum for a UNIX socket; "
            "choose a shorter run directory"
        )
    _clear_stale(path, what)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.setblocking(False)
    try:
        with private_files():
            listener.bind(str(path))
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        raise FleetError(
            f"{what}: cannot listen on {path}: {error}; its directory must exist and be writable"
        ) from error
    return listener


def accept(listener: socket.socket) -> socket.socket | None:
    """Return one client from the queue, or None if there is none; never blocks."""
    try:
        client, _ = listener.accept()
    except OSError:
        return None
    client.setblocking(False)
    return client


def _clear_stale(path: Path, what: str) -> None:
    """Remove a dead socket file; refuse a socket in use, and a file that is not a socket."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise FleetError(f"{what}: {path} exists and is not a socket; remove it")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        if probe.connect_ex(str(path)) != errno.ECONNREFUSED:
            raise FleetError(f"{what}: {path} is in use; stop the simulator that holds it")
    path.unlink(missing_ok=True)
