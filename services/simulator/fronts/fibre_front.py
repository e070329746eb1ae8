"""The native (Fibre, legacy packet format) side of the emulated drives (docs/drives.md).

`FibreFront` is the protocol of one board, bytes in and bytes out; little-endian throughout.

Request: sequence number, endpoint id (bit 15: an answer is wanted), size of the answer,
payload, and a trailer that says which table of endpoints the client means. Answer: the
sequence number with bit 15 set, payload.

Source: odriverobotics/ODrive, docs/protocol.rst and Firmware/fibre-cpp.
"""

from __future__ import annotations

import json
import struct
from typing import Any, Final

from services.simulator.fronts.fibre_endpoints import (
    CODECS,
    Argument,
    EmulatedBoard,
    Endpoint,
    Function,
    Property,
    endpoints,
)
from shared.exceptions import DriveError

PROTOCOL_VERSION: Final = 1
ANSWER_BYTES: Final = 62
"""Bytes after the sequence number in a packet of 64 bytes; a longer reply is cut."""

_CRC16_POLYNOMIAL = 0x3D65
_ANSWER = 0x8000
_VERSION_ID = 0xFFFF_FFFF  # this "offset" into the JSON asks for its id instead
_HEADER = struct.Struct("<HHH")
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_CODECS = {name: struct.Struct("<" + letter) for name, letter in CODECS.items()}


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
        descriptor: the JSON with endpoints and ids, for clients.
        ignored: packets that are no valid request, which the firmware ignores too, and values that
            no setting can have.
    """

    def __init__(self, board: EmulatedBoard) -> None:
        self.board = board
        self.ignored = 0
        self._rows = endpoints()
        self._arguments: dict[int, float] = {
            number: 0 for number, row in enumerate(self._rows) if isinstance(row, Argument)
        }
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
        if sequence & _ANSWER or trailer != (self._crc if number else PROTOCOL_VERSION):
            self.ignored += 1
            return None
        known = number <= len(self._rows)  # of any other the firmware has nothing to say
        result = self._operate(number, payload)[: min(size, ANSWER_BYTES)] if known else b""
        if not endpoint & _ANSWER:
            return None
        return _U16.pack(sequence | _ANSWER) + result

    def _operate(self, number: int, payload: bytes) -> bytes:
        """Return the endpoint's value; then write to it, or call it."""
        if number == 0:
            return self._describe(payload)
        row = self._rows[number - 1]
        if isinstance(row, Function):
            first = number  # the index of its first argument: ids count from 1
            values = [self._arguments[first + i] for i in range(len(row.arguments))]
            row.call(self.board, *values)
            return b""
        codec = _CODECS[row.type]
        if isinstance(row, Argument):
            held = codec.pack(self._arguments[number - 1])
            if len(payload) >= codec.size:
                self._arguments[number - 1] = codec.unpack_from(payload)[0]
            return held
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


def _tree(rows: list[Endpoint]) -> list[dict[str, Any]]:
    """Return the JSON descriptor of endpoints with dotted names; ids count from 1."""
    root: list[dict[str, Any]] = [{"name": "", "id": 0, "type": "json", "access": "r"}]
    objects = {"": root}

    def members(path: str) -> list[dict[str, Any]]:
        if path not in objects:
            above, _, name = path.rpartition(".")
            objects[path] = []
            members(above).append({"name": name, "type": "object", "members": objects[path]})
        return objects[path]

    for number, row in enumerate(rows, start=1):
        if not isinstance(row, Argument):
            path, _, name = row.name.rpartition(".")
            members(path).append({"name": name, "id": number, **_description(number, row)})
    return root


def _description(number: int, row: Property | Function) -> dict[str, Any]:
    if isinstance(row, Property):
        return {"type": row.type, "access": "r" if row.write is None else "rw"}
    inputs = [
        {"name": each.name, "id": number + 1 + i, "type": each.type, "access": "rw"}
        for i, each in enumerate(row.arguments)
    ]
    return {"type": "function", "inputs": inputs, "outputs": []}
