"""A CAN bus on one host: python-can over a UNIX socket (docs/drives.md).

`UnixCanBus` is the client, `can.Bus(interface="xrl_unix", channel=path)`; the bus itself is
`services.simulator.fronts.unix_can_hub.UnixCanHub`, held by the simulator. The code that drives a
real bus through socketcan drives this one unchanged.

On the wire: SOCK_SEQPACKET; a packet carries one or several 16-byte frames in the layout of
SocketCAN's `struct can_frame` (id and flags, length, three pad bytes, eight data bytes),
little-endian. Several frames in one packet cost one system call. Sending never blocks: a packet
that does not fit into a socket is dropped and counted.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Final

import can

EXTENDED_FLAG: Final = 0x8000_0000
REMOTE_FLAG: Final = 0x4000_0000
ERROR_FLAG: Final = 0x2000_0000
STANDARD_MASK: Final = 0x7FF
EXTENDED_MASK: Final = 0x1FFF_FFFF

Frame = tuple[int, bytes]
"""SocketCAN id with its flags, and up to eight data bytes."""

_FRAME = struct.Struct("<IB3x8s")
PACKET_BYTES: Final = 64 * _FRAME.size
"""Longest packet that either side sends."""
_DRAIN = 1024  # packets in one call: more than a socket holds


def pack_frames(frames: Iterable[Frame]) -> bytes:
    """Return one packet that carries the frames."""
    return b"".join(_FRAME.pack(can_id, len(data), data) for can_id, data in frames)


def unpack_frames(packet: bytes) -> list[Frame]:
    """Return the frames of a packet; none if it is not a whole number of frames."""
    if len(packet) % _FRAME.size:
        return []
    return [(can_id, data[:length]) for can_id, length, data in _FRAME.iter_unpack(packet)]


class UnixCanBus(can.BusABC):
    """Client of a `UnixCanHub`, declared to python-can as interface `xrl_unix`.

    Unlike most interfaces, `send` drops a frame when the socket is full, counts it in `dropped`,
    and does not raise: a control loop has a newer one in a millisecond.
    """

    def __init__(
        self, channel: str, can_filters: can.typechecking.CanFilters | None = None, **kwargs: object
    ) -> None:
        """Connect to the hub that listens on path `channel`, or can.CanInitializationError."""
        self.dropped = 0
        self.channel_info = f"xrl_unix {channel}"
        self._waiting: deque[can.Message] = deque()
        self._timeout_s: float | None = None
        self._socket = _connect(channel)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        super().__init__(channel, can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Send one frame without waiting, whatever `timeout` says; as `send_many`."""
        self.send_many((msg,))

    def send_many(self, messages: Sequence[can.Message]) -> None:
        """Send frames in one packet without waiting; can.CanOperationError once the hub is gone."""
        packet = b"".join(
            [
                _FRAME.pack(_can_id(message), message.dlc, bytes(message.data))
                for message in messages
            ]
        )
        try:
            self._socket.send(packet, socket.MSG_DONTWAIT)
        except BlockingIOError:
            self.dropped += len(messages)
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error

    def recv_many(self, timeout: float) -> list[Frame]:
        """Wait for a packet and return the frames of all packets that are there, in order.

        The fast path around `can.Message`; filters are not applied. Empty after `timeout` seconds.
        Raises can.CanOperationError once the hub is gone.
        """
        packet = self._receive(timeout)
        if packet is None:
            return []
        frames = unpack_frames(packet)
        for _ in range(_DRAIN):
            packet = self._receive(0.0)
            if packet is None:
                break
            frames += unpack_frames(packet)
        return frames

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._socket.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next frame as python-can asks for it; filters are left to python-can."""
        if not self._waiting:
            packet = self._receive(timeout)
            if packet is None:
                return None, False
            now = time.time()
            self._waiting.extend(_message(frame, now) for frame in unpack_frames(packet))
        return (self._waiting.popleft() if self._waiting else None), False

    def _receive(self, timeout: float | None) -> bytes | None:
        """Return a packet, or None when `timeout` seconds have brought none.

        The kernel keeps the time (SO_RCVTIMEO): one system call instead of two.
        """
        if timeout is not None and timeout <= 0.0:
            if not self._poll.poll(0):  # a third of the price of a BlockingIOError
                return None
        elif timeout != self._timeout_s:
            _set_receive_timeout(self._socket, timeout)
            self._timeout_s = timeout
        try:
            packet = self._socket.recv(PACKET_BYTES)
        except BlockingIOError:
            return None
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error
        if not packet:
            raise can.CanOperationError(f"{self.channel_info}: the hub has closed")
        return packet


def _can_id(message: can.Message) -> int:
    """Return the SocketCAN id of a message, with its flags."""
    can_id: int = message.arbitration_id
    if message.is_extended_id:
        can_id |= EXTENDED_FLAG
    if message.is_remote_frame:
        can_id |= REMOTE_FLAG
    return can_id


def _message(frame: Frame, timestamp: float) -> can.Message:
    """Return a frame as python-can has it."""
    can_id, data = frame
    extended = bool(can_id & EXTENDED_FLAG)
    return can.Message(
        timestamp=timestamp,
        arbitration_id=can_id & (EXTENDED_MASK if extended else STANDARD_MASK),
        is_extended_id=extended,
        is_remote_frame=bool(can_id & REMOTE_FLAG),
        is_error_frame=bool(can_id & ERROR_FLAG),
        data=data,
    )


def _connect(channel: str) -> socket.socket:
    """Connect to a hub; a hub too busy to take us is an error, not a wait."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.setblocking(False)
    try:
        client.connect(channel)
    except OSError as error:
        client.close()
        raise can.CanInitializationError(
            f"no CAN hub listens on {channel} ({error}); start the simulator first"
        ) from error
    client.setblocking(True)
    return client


def _set_receive_timeout(client: socket.socket, timeout: float | None) -> None:
    """Set SO_RCVTIMEO; None waits for ever, anything else at least 1 us."""
    microseconds = 0 if timeout is None else max(1, int(timeout * 1e6))
    value = struct.pack("@ll", *divmod(microseconds, 1_000_000))
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
