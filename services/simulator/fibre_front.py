"""The native (Fibre, legacy packet format) side of the emulated drives (design section 5).

`FibreFront` is the protocol of one board, bytes in and bytes out; `FibrePort` is its USB
plug: a UNIX socket, one packet per bulk transfer. Little-endian throughout.

Request: sequence number, endpoint id (bit 15: an answer is wanted), size of the answer,
payload, and a trailer that says which table of endpoints the client means. Answer: the
sequence number with bit 15 set, payload.

Source: odriverobotics/ODrive, docs/protocol.rst and Firmware/fibre-cpp.
"""

from __future__ import annotations

import errno
import json
import select
import socket
import struct
from pathlib import Path
from typing import Any, Final

from services.simulator.fibre_endpoints import (
    CODECS,
    Board,
    Endpoint,
    Function,
    Property,
    endpoints,
)
from shared.exceptions import DriveError, FleetError

PROTOCOL_VERSION: Final = 1
PACKET_BYTES: Final = 64
"""A full-speed bulk transfer."""

_CRC16_POLYNOMIAL = 0x3D65
_ANSWER = 0x8000
_VERSION_ID = 0xFFFF_FFFF  # this "offset" into the JSON asks for its id instead
_HEADER = struct.Struct("<HHH")
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_BACKLOG = 16
_ROUNDS = 64  # a client that floods the link must not hold up the simulator


def crc16(initial: int, data: bytes) -> int:
    """Return Fibre's CRC16: polynomial 0x3d65, nothing reflected, no final xor."""
    crc = initial
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (_CRC16_POLYNOMIAL if crc & 0x8000 else 0)) & 0xFFFF
    return crc


class FibreFront:
    """The protocol of one board.

    Attributes:
        descriptor: the JSON that tells clients the endpoints and their ids.
        ignored: packets that were no valid request, on which the firmware is silent too, and
            values that no setting can have.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self.ignored = 0
        self._rows = endpoints()
        self.descriptor = json.dumps(_tree(self._rows), separators=(",", ":")).encode()
        self._crc = crc16(PROTOCOL_VERSION, self.descriptor)
        self._version_id = self._crc << 16 | crc16(self._crc, self.descriptor)

    def answer(self, packet: bytes) -> bytes | None:
        """Carry out one request; return the answer, None if there is none."""
        if len(packet) < _HEADER.size + _U16.size:
            self.ignored += 1
            return None
        sequence, endpoint, size = _HEADER.unpack_from(packet)
        (trailer,) = _U16.unpack_from(packet, len(packet) - _U16.size)
        payload = packet[_HEADER.size : -_U16.size]
        number = endpoint & ~_ANSWER
        known = number <= len(self._rows)
        if (
            sequence & _ANSWER
            or not known
            or trailer != (self._crc if number else PROTOCOL_VERSION)
        ):
            self.ignored += 1
            return None
        result = self._operate(number, payload)[:size]
        if not endpoint & _ANSWER:
            return None
        return _U16.pack(sequence | _ANSWER) + result

    def _operate(self, number: int, payload: bytes) -> bytes:
        """Return what the endpoint held; then write to it, or call it."""
        if number == 0:
            return self._describe(payload)
        row = self._rows[number - 1]
        if isinstance(row, Function):
            row.call(self.board)
            return b""
        codec = struct.Struct("<" + CODECS[row.type])
        held = codec.pack(row.read(self.board))
        if row.write is not None and len(payload) >= codec.size:
            try:
                row.write(self.board, codec.unpack_from(payload)[0])
            except DriveError:
                self.ignored += 1
        return held

    def _describe(self, payload: bytes) -> bytes:
        """Return a part of the descriptor, or its id."""
        if len(payload) < _U32.size:
            return b""
        (offset,) = _U32.unpack_from(payload)
        if offset == _VERSION_ID:
            return _U32.pack(self._version_id)
        return self.descriptor[offset:]


class FibrePort:
    """The USB plug of one board: a listening socket whose file name is the serial number.

    While the board does not talk (`AxisBank.talks`: no power, booting, cable pulled) the plug
    is out: every client loses the drive at once, and finds it again when it is back.

    Raises:
        FleetError: the path cannot be listened on.
    """

    def __init__(self, front: FibreFront, path: Path) -> None:
        self.path = path
        self.front = front
        self._clients: dict[int, socket.socket] = {}
        self._listener: socket.socket | None = None
        self._epoll = select.epoll()
        self._plug()

    @property
    def clients(self) -> int:
        """How many processes see this drive."""
        return len(self._clients)

    def fileno(self) -> int:
        """Return the descriptor that is readable when there is something for `poll`."""
        return self._epoll.fileno()

    def poll(self) -> None:
        """Answer all requests that have come; admit new clients. Never waits."""
        if self.front.board.talks != (self._listener is not None):
            (self._plug if self._listener is None else self._unplug)()
        for _ in range(_ROUNDS):
            ready = self._epoll.poll(0)
            if not ready:
                break
            for descriptor, _event in ready:
                client = self._clients.get(descriptor)
                if client is None:
                    self._admit()
                else:
                    self._serve(client)

    def close(self) -> None:
        """Pull the plug for good."""
        self._unplug()
        self._epoll.close()

    def _plug(self) -> None:
        """Put the plug in; clients find the drive when they next look."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        listener.setblocking(False)
        try:
            self._clear_stale()
            listener.bind(str(self.path))
            listener.listen(_BACKLOG)
        except OSError as error:
            listener.close()
            raise FleetError(
                f"USB port: cannot listen on {self.path}: {error}; its directory must exist, be "
                "writable and short enough, and no other simulator may hold it"
            ) from error
        self._listener = listener
        self._epoll.register(listener, select.EPOLLIN)

    def _unplug(self) -> None:
        """Pull the plug."""
        if self._listener is None:
            return
        self.path.unlink(missing_ok=True)
        self._epoll.unregister(self._listener)
        self._listener.close()
        self._listener = None
        for client in tuple(self._clients.values()):
            self._part(client)

    def _clear_stale(self) -> None:
        """Remove a socket file that nobody listens on."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
            probe.setblocking(False)
            if probe.connect_ex(str(self.path)) == errno.ECONNREFUSED:
                self.path.unlink(missing_ok=True)

    def _admit(self) -> None:
        """Take one client from the queue, if it is still there."""
        if self._listener is None:
            return
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        client.setblocking(False)
        self._clients[client.fileno()] = client
        self._epoll.register(client, select.EPOLLIN)

    def _serve(self, client: socket.socket) -> None:
        """Answer one packet of a ready client; part with a client that has gone."""
        try:
            packet = client.recv(PACKET_BYTES)
            answer = self.front.answer(packet) if packet else None
            if answer is not None:
                client.send(answer)
        except BlockingIOError:
            return  # a client that does not read loses its answers, as on a real bus
        except OSError:
            packet = b""
        if not packet:
            self._part(client)

    def _part(self, client: socket.socket) -> None:
        """Close a client's side."""
        if self._clients.pop(client.fileno(), None) is not None:
            self._epoll.unregister(client)
            client.close()


def _tree(rows: list[Endpoint]) -> list[dict[str, Any]]:
    """Return the JSON descriptor of endpoints with dotted names; ids count from 1."""
    root: list[dict[str, Any]] = [{"name": "", "id": 0, "type": "json", "access": "r"}]
    for number, row in enumerate(rows, start=1):
        members = root
        *path, leaf = row.name.split(".")
        for name in path:
            members = _object(members, name)
        members.append(_entry(leaf, number, row))
    return root


def _object(members: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """Return the members of a named object, which is added if it is not there."""
    for member in members:
        if member["name"] == name:
            found: list[dict[str, Any]] = member["members"]
            return found
    added: list[dict[str, Any]] = []
    members.append({"name": name, "type": "object", "members": added})
    return added


def _entry(name: str, number: int, row: Endpoint) -> dict[str, Any]:
    if isinstance(row, Property):
        access = "r" if row.write is None else "rw"
        return {"name": name, "id": number, "type": row.type, "access": access}
    return {"name": name, "id": number, "type": "function", "inputs": [], "outputs": []}
