"""A CAN interface of the kernel: limit the frames that wait in it, and discard them.

In Linux (net/can/raw.c, include/linux/can/skb.h, drivers/net/can/dev), a frame waits in the
interface's queue (pfifo_fast, txqueuelen), where it is charged to its socket (SO_SNDBUF), then in
the adapter, where it is not. Both queues outlive the socket, and neither drops a frame because of
its age. Taking the interface down drops all frames and resets the adapter. CAN sockets have no
SIOCOUTQ, and SO_MEMINFO does not count the adapter's frames: only the echo of a sent frame
(CAN_RAW_RECV_OWN_MSGS) shows that it was transmitted.
"""

from __future__ import annotations

import fcntl
import socket
import struct
from typing import Any, Final

from shared.can.unix_can import FRAME_TRUESIZE

QUEUED_MAX: Final = 14
"""Maximum number of frames of one process that wait in the kernel: the longest burst."""

_SIOCGIFFLAGS: Final = 0x8913
_SIOCSIFFLAGS: Final = 0x8914
_IFF_UP: Final = 1
_REQUEST: Final = struct.Struct("16sh22x")


def limit_queue(bus: Any) -> None:
    """Limit the waiting frames of a bus to `QUEUED_MAX`, if it has a socket.

    The kernel doubles the value. A socket with half of that in use counts as not writable, and
    python-can then sends nothing.
    """
    sender = getattr(bus, "socket", None)
    if isinstance(sender, socket.socket):
        sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUED_MAX * FRAME_TRUESIZE)


def restart(bus: Any, channel: str) -> None:
    """Take a bus's interface down and up again, which discards the waiting frames.

    Raises:
        OSError: this process lacks CAP_NET_ADMIN, or the interface does not exist.
    """
    own = getattr(bus, "restart", None)
    if own is not None:
        own()
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        name = channel.encode()
        _, flags = _REQUEST.unpack(fcntl.ioctl(control, _SIOCGIFFLAGS, _REQUEST.pack(name, 0)))
        for wanted in (flags & ~_IFF_UP, flags | _IFF_UP):
            fcntl.ioctl(control, _SIOCSIFFLAGS, _REQUEST.pack(name, wanted))
