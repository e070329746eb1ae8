"""Sockets that are to be closed at once, whatever is still on its way (Linux /proc).

For sockets that a library opens in this process and keeps to itself.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from pathlib import Path
from typing import Final

Address = tuple[str, int]
"""Numeric host and port."""

_RESET: Final = struct.pack("ii", 1, 0)


def reset_on_close(local: Address, remote: Address) -> bool:
    """Have this process's TCP connection between two addresses closed by a reset.

    With a linger time, `close` blocks its thread until the other side has received everything or
    the time is over. Without any, the kernel goes on sending to a host that is cut off, and a TLS
    link that is dialled again meanwhile was not led again within 30 s. A reset drops what is
    unsent: it is older than what the next link brings.

    Returns:
        False if there is no such connection.
    """
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile, or no socket with a peer
            if not str(entry.readlink()).startswith("socket:"):
                continue
            connection = socket.socket(fileno=int(entry.name))
            try:
                if connection.family not in (socket.AF_INET, socket.AF_INET6):
                    continue
                ends = connection.getsockname()[:2], connection.getpeername()[:2]
                if ends == (local, remote):
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
                    return True
            finally:
                connection.detach()  # it is not ours to close
    return False
