"""TCP sockets of this process and host, from the kernel (Linux): Zenoh does not expose its own.

A TLS listener of Zenoh sleeps for 100 ms after each failed handshake. It then accepts all
connections that arrived meanwhile, each with a descriptor: 640 bad connections a second left 4700
open in a minute. With a queue of one it accepts only as many as it closes. The firewall decides
which addresses reach the ports (`deploy/nftables`).
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final, TypeAlias

IpAddress: TypeAlias = "ipaddress.IPv4Address | ipaddress.IPv6Address"
Address = tuple[str, int]
"""Numeric host and port."""

_SYN_COOKIES: Final = Path("/proc/sys/net/ipv4/tcp_syncookies")
_RESET: Final = struct.pack("ii", 1, 0)


def shorten_queues(ports: Collection[int]) -> None:
    """Limit this process's listeners at these ports to one waiting connection at a time."""
    for own in _own_sockets():
        if _listening_port(own) in ports:
            own.listen(_waiting_max())


def reset_on_close(local: Address, remote: Address) -> bool:
    """Make a TCP connection close with a reset; return False if it is not found.

    With a linger time, `close` blocks its thread until the other side has received everything or
    the time is over. Without one, the kernel keeps sending to a host that is cut off, and after the
    TLS link was dialled again the planner did not lead within 30 s. A reset drops the unsent data,
    which is older than the data on the next link.
    """
    for own in _own_sockets():
        with contextlib.suppress(OSError):  # not connected
            if (own.getsockname()[:2], own.getpeername()[:2]) == (local, remote):
                own.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
                return True
    return False


def addresses_of(host: str) -> set[IpAddress]:
    """Return the addresses of a host; empty if its name is unknown. A name lookup may block."""
    try:
        rows = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return set()
    return {ipaddress.ip_address(row[4][0]) for row in rows}


def _own_sockets() -> Iterator[socket.socket]:
    """Yield each IP socket of this process; the caller must not close it."""
    for entry in Path("/proc/self/fd").iterdir():
        try:
            if not str(entry.readlink()).startswith("socket:"):
                continue
            own = socket.socket(fileno=int(entry.name))
        except OSError:  # another thread has closed it meanwhile
            continue
        try:
            if own.family in (socket.AF_INET, socket.AF_INET6):
                yield own
        finally:
            own.detach()


def _listening_port(own: socket.socket) -> int | None:
    with contextlib.suppress(OSError):
        if own.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
            return int(own.getsockname()[1])
    return None


def _waiting_max() -> int:
    """Return the backlog for a queue of one; without SYN cookies, 0 would accept nothing."""
    return 0 if _SYN_COOKIES.exists() and _SYN_COOKIES.read_text().strip() != "0" else 1


# ---- connections of this host, from /proc/net

_PROC_NET: Final = Path("/proc/net")
_TCP: Final = ("tcp", "tcp6")
_ESTABLISHED: Final = re.compile(
    rb"^ *\d+: \S+ ([0-9A-F]+):([0-9A-F]{4}) 01 (?:\S+ +){5}(\d+)", re.MULTILINE
)
"""Remote address and port, and the socket's inode."""


def established(inodes: Collection[int], proc_net: Path = _PROC_NET) -> set[Address]:
    """Return the remote addresses and ports of the TCP connections with these socket inodes."""
    return {
        (str(_address(address)), int(port, 16))
        for address, port, inode in _ESTABLISHED.findall(_tables(proc_net, *_TCP))
        if int(inode) in inodes
    }


def _tables(proc_net: Path, *names: str) -> bytes:
    """Return the kernel's tables, concatenated; a kernel without IPv6 lacks one."""
    found = b""
    for name in names:
        with contextlib.suppress(OSError):
            found += (proc_net / name).read_bytes()
    return found


def _address(text: bytes) -> IpAddress:
    """Return an address of /proc/net/tcp: 32-bit words in this machine's byte order."""
    words = bytes.fromhex(text.decode())
    packed = b"".join(struct.pack(">I", word) for (word,) in struct.iter_unpack("=I", words))
    address = ipaddress.ip_address(packed)
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return mapped or address
