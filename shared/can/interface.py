"""A CAN interface of the kernel: how many frames may wait in it, and how they are thrown away.

Facts, by Linux' sources (net/can/raw.c, include/linux/can/skb.h, drivers/net/can/dev): a frame
waits in the interface's queue (pfifo_fast, txqueuelen), charged to its socket (SO_SNDBUF),
then in the adapter, charged to nobody. Both outlive the socket. Neither drops a frame for its age;
taking the interface down does, and resets the adapter. SIOCOUTQ is not for CAN sockets, and
SO_MEMINFO does not count what the adapter has: an own frame that comes back
(CAN_RAW_RECV_OWN_MSGS) is the only sign that it was transmitted.
"""

from __future__ import annotations

import fcntl
import socket
import struct
from typing import Any, Final

from shared.can.unix_can import FRAME_TRUESIZE

QUEUED_MAX: Final = 14
"""Frames of one process that may wait in the kernel: the longest row that is sent at once."""

_SIOCGIFFLAGS: Final = 0x8913
_SIOCSIFFLAGS: Final = 0x8914
_IFF_UP: Final = 1
_REQUEST: Final = struct.Struct("16sh22x")


def limit_queue(bus: Any) -> None:
    """Let no more than `QUEUED_MAX` frames of a bus wait, if it has a socket.

    The kernel doubles what is set, and a socket with half of that in use counts as not writable:
    python-can sends nothing then.
    """
    sender = getattr(bus, "socket", None)
    if isinstance(sender, socket.socket):
        sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUED_MAX * FRAME_TRUESIZE)


def restart(bus: Any, channel: str) -> None:
    """Take a bus's interface down and up again: frames that wait are thrown away.

    Raises:
        OSError: this process may not (CAP_NET_ADMIN), or there is no such interface.
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
