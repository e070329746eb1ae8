"""Zenoh's wire format: batches on a stream, and which of them carry messages.

On a stream each batch is a length of two bytes, little endian, then as many bytes. A batch holds
frames; a frame a header, a sequence number, extensions and network messages (zenoh-protocol, wire
version 9). Messages of the application are PUSH; all else (opening a link, declaring subscriptions,
keeping alive) is the link's own traffic. A datagram network would retransmit it and a stream does
not, so it may be late but never lost.
"""

from __future__ import annotations

import struct
from typing import Final

_LENGTH: Final = struct.Struct("<H")
_ID: Final = 0x1F  # low five bits of every header
_EXTENDED: Final = 0x80  # of a header: extensions follow
_FRAME: Final = 0x05
_PUSH: Final = 0x1D
_ENCODING: Final = 0x60  # of an extension: unit, number or bytes
_NUMBER: Final = 0x20
_BYTES: Final = 0x40


class Splitter:
    """Cuts a stream into batches."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return every batch that is whole now, each with its length before it."""
        data = self._rest + data
        begin, batches = 0, []
        while begin + 2 <= len(data):
            end = begin + 2 + _LENGTH.unpack_from(data, begin)[0]
            if end > len(data):
                break
            batches.append(data[begin:end])
            begin = end
        self._rest = data[begin:]
        return batches


def carries_messages(batch: bytes) -> bool:
    """Return True for a batch of the application's messages, which a network may lose.

    What cannot be read is none: it is late, but never lost.
    """
    try:
        if batch[2] & _ID != _FRAME:
            return False
        _, at = _number(batch, 3)
        if batch[2] & _EXTENDED:
            at = _after_extensions(batch, at)
        return batch[at] & _ID == _PUSH
    except IndexError:
        return False


def _number(batch: bytes, at: int) -> tuple[int, int]:
    """Return a number of seven bits a byte, least significant first, and where it ends."""
    value, shift = 0, 0
    while True:
        byte = batch[at]
        value, shift, at = value | (byte & 0x7F) << shift, shift + 7, at + 1
        if not byte & 0x80:
            return value, at


def _after_extensions(batch: bytes, at: int) -> int:
    more = True
    while more:
        header = batch[at]
        at, more = at + 1, bool(header & _EXTENDED)
        if header & _ENCODING == _NUMBER:
            _, at = _number(batch, at)
        elif header & _ENCODING == _BYTES:
            length, at = _number(batch, at)
            at += length
    return at
