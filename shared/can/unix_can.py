"""A CAN bus on one host: python-can over a UNIX socket (docs/drives.md).

`UnixCanBus` is the client, `can.Bus(interface="xrl_unix", channel=path)`; the bus itself is
`services.simulator.fronts.unix_can_hub.UnixCanHub`, in the simulator. The code that drives a real
bus through socketcan drives this one unchanged.

On the wire: SOCK_SEQPACKET; a packet carries one or several 16-byte frames in the layout of
SocketCAN's `struct can_frame` (id and flags, length, three pad bytes, eight data bytes),
little-endian. Several frames in one packet cost one system call. Sending never blocks: a full queue
raises, as on socketcan.

**While no node acknowledges,** the hub leaves the packets in the kernel, in order and charged to
the sender (SO_SNDBUF), even after the sender has ended. A CAN interface behaves the same: its
controller repeats its first frame until a node acknowledges it. Hub and clients share the rest of
an interface's state in `Interface`.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import select
import socket
import struct
import termios
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path
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
FRAME_BYTES: Final = _FRAME.size
pack_frame: Final = _FRAME.pack
"""Pack id with flags, number of data bytes, and data."""
PACKET_BYTES: Final = 64 * FRAME_BYTES
"""Maximum packet of either side."""
_DRAIN = 1024  # packets in one call: more than a socket holds
FRAME_TRUESIZE: Final = 768
"""Bytes of SO_SNDBUF for a short packet (sk_buff and data); a CAN socket's frame takes as many."""


def pack_frames(frames: Iterable[Frame]) -> bytes:
    """Return one packet that carries the frames."""
    return b"".join(_FRAME.pack(can_id, len(data), data) for can_id, data in frames)


def unpack_frames(packet: bytes) -> list[Frame]:
    """Return the frames of a packet; empty if it is not a whole number of frames."""
    if len(packet) % FRAME_BYTES:
        return []
    return [(can_id, data[:length]) for can_id, length, data in _FRAME.iter_unpack(packet)]


FULL_AT: Final = 4
"""Offset of `Interface.full` in its memory."""


class Interface:
    """State of an emulated CAN interface, in memory that the hub and its clients share."""

    def __init__(self, channel: str | os.PathLike[str], *, create: bool = False) -> None:
        """Open the state of the interface with this socket; the hub creates it.

        Raises:
            OSError: the state does not exist.
        """
        self.path = Path(f"{os.fspath(channel)}.state")
        if create:  # a client of an earlier hub may still have the old file mapped
            self.path.unlink(missing_ok=True)
        flags = os.O_RDWR | (os.O_CREAT | os.O_EXCL if create else 0)
        descriptor = os.open(self.path, flags, 0o600)
        try:
            if create:
                os.ftruncate(descriptor, FULL_AT + 1)
            self.memory = mmap.mmap(descriptor, FULL_AT + 1)
        finally:
            os.close(descriptor)

    @property
    def full(self) -> bool:
        """True while the send queue (txqueuelen) accepts no frame: ENOBUFS."""
        return self.memory[FULL_AT] != 0

    @full.setter
    def full(self, full: bool) -> None:
        self.memory[FULL_AT] = full

    @property
    def restarts(self) -> int:
        """Number of times the interface was taken down and up, which empties its queue."""
        return int.from_bytes(self.memory[:FULL_AT], "little")

    def restart(self) -> None:
        """Request that the hub discard all waiting frames."""
        count = self.restarts + 1 & 0xFFFF_FFFF
        self.memory[:FULL_AT] = count.to_bytes(FULL_AT, "little")

    def close(self) -> None:
        """Release the memory."""
        self.memory.close()


class UnixCanBus(can.BusABC):
    """Client of a `UnixCanHub`, declared to python-can as interface `xrl_unix`.

    Attributes:
        dropped: frames that were not sent: the queue was full, or the hub was gone.
        socket: its SO_SNDBUF limits the waiting frames, as on socketcan.
    """

    def __init__(
        self,
        channel: str,
        can_filters: can.typechecking.CanFilters | None = None,
        *,
        receive_own_messages: bool = False,
        **kwargs: object,
    ) -> None:
        """Connect to the hub on path `channel`; raise can.CanInitializationError if there is none.

        With `receive_own_messages`, `carried` returns this client's own frames once the bus has
        carried them (as CAN_RAW_RECV_OWN_MSGS does).
        """
        self.dropped = 0
        self.channel_info = f"xrl_unix {channel}"
        self._echoes = receive_own_messages
        self._uncarried: deque[bytes] = deque()
        self._waiting: deque[can.Message] = deque()
        self._timeout_s: float | None = None
        self.socket, self._interface = _connect(channel)
        self._poll = select.poll()
        self._poll.register(self.socket, select.POLLIN)
        super().__init__(channel, can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Send one frame without waiting, regardless of `timeout`.

        Raises:
            can.CanOperationError: the queue is full (ENOBUFS), or the hub is gone.
        """
        if not self.send_packet(pack_frame(_can_id(msg), msg.dlc, bytes(msg.data))):
            raise can.CanOperationError(
                f"{self.channel_info}: not sent: queue full (ENOBUFS), or the simulator has ended",
                errno.ENOBUFS,
            )

    def send_packet(self, packet: bytes) -> int:
        """Send packed frames without waiting; return the number of bytes sent: all, or 0.

        The fast path, which avoids `can.Message`. If the hub is gone, only receiving raises.
        """
        if not self._interface.memory[FULL_AT]:
            try:
                self.socket.send(packet, socket.MSG_DONTWAIT)
            except OSError:
                pass
            else:
                if self._echoes:
                    self._uncarried.append(packet)
                return len(packet)
        self.dropped += len(packet) // FRAME_BYTES
        return 0

    def recv_packet(self, timeout: float) -> bytes:
        """Wait for a packet; return all packets that have arrived, joined in order.

        The fast path, which avoids `can.Message`; filters are not applied. Returns b"" if no packet
        arrives within `timeout` seconds. Raises can.CanOperationError once the hub is gone.
        """
        packet = self._receive(timeout)
        if packet is None:
            return b""
        for _ in range(_DRAIN):
            more = self._receive(0.0)
            if more is None:
                break
            packet += more
        return packet

    def carried(self) -> bytes:
        """Return our frames that the bus has carried since the last call.

        Empty without `receive_own_messages`.
        """
        if not self._uncarried:
            return b""
        waiting = struct.unpack("i", fcntl.ioctl(self.socket, termios.TIOCOUTQ, bytes(4)))[0]
        packets = -(-waiting // FRAME_TRUESIZE)
        carried = b""
        while len(self._uncarried) > packets:
            carried += self._uncarried.popleft()
        return carried

    def restart(self) -> None:
        """Take the interface down and up: discard the waiting frames of every client."""
        self._interface.restart()
        self._uncarried.clear()

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self.socket.fileno()

    def shutdown(self) -> None:
        """Leave the bus; frames in its queue stay there."""
        super().shutdown()
        self.socket.close()
        self._interface.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next frame for python-can, which applies the filters."""
        if not self._waiting:
            packet = self._receive(timeout)
            if packet is None:
                return None, False
            now = time.time()
            self._waiting.extend(_message(frame, now) for frame in unpack_frames(packet))
        return (self._waiting.popleft() if self._waiting else None), False

    def _receive(self, timeout: float | None) -> bytes | None:
        """Return a packet of whole frames, or None after `timeout` seconds without one.

        The kernel measures the timeout (SO_RCVTIMEO): one system call instead of two.
        """
        if timeout is not None and timeout <= 0.0:
            if not self._poll.poll(0):  # takes a third of the time of a BlockingIOError
                return None
        elif timeout != self._timeout_s:
            _set_receive_timeout(self.socket, timeout)
            self._timeout_s = timeout
        try:
            packet = self.socket.recv(PACKET_BYTES)
        except BlockingIOError:
            return None
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error
        if not packet:
            raise can.CanOperationError(f"{self.channel_info}: the hub has closed")
        return b"" if len(packet) % FRAME_BYTES else packet


def _can_id(message: can.Message) -> int:
    """Return the SocketCAN id of a message, with its flags."""
    can_id: int = message.arbitration_id
    if message.is_extended_id:
        can_id |= EXTENDED_FLAG
    if message.is_remote_frame:
        can_id |= REMOTE_FLAG
    return can_id


def _message(frame: Frame, timestamp: float) -> can.Message:
    """Return a frame as python-can's message."""
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


def _connect(channel: str) -> tuple[socket.socket, Interface]:
    """Connect to a hub; raise at once if the hub is too busy."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.setblocking(False)
    try:
        client.connect(channel)
        interface = Interface(channel)
    except OSError as error:
        client.close()
        raise can.CanInitializationError(
            f"no CAN hub listens on {channel} ({error}); start the simulator first"
        ) from error
    client.setblocking(True)
    return client, interface


def _set_receive_timeout(client: socket.socket, timeout: float | None) -> None:
    """Set SO_RCVTIMEO; None waits forever, anything else at least 1 us."""
    microseconds = 0 if timeout is None else max(1, int(timeout * 1e6))
    value = struct.pack("@ll", *divmod(microseconds, 1_000_000))
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
