"""Connections at the ports of this host's services, as the kernel has them (Linux /proc/net).

Zenoh tells nobody of a handshake that fails. A flood shows in the connections that the kernel
turns away because a listener's queue is full (`shared.bus.allow_list`), and in who begins others.
"""

from __future__ import annotations

import ipaddress
import re
import struct
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Final, NamedTuple

from shared.bus.allow_list import IpAddress
from shared.clock import NS_PER_S

FLOOD_HZ: Final = 20.0
"""Connections turned away per second from which it is a flood; a fleet that starts has a few."""

_PROC_NET: Final = Path("/proc/net")
_TCP: Final = ("tcp", "tcp6")
_ROW: Final = re.compile(
    rb"^ *\d+: [0-9A-F]+:([0-9A-F]{4}) ([0-9A-F]+):([0-9A-F]{4}) (?!0A)", re.MULTILINE
)
"""Own port, other address and port; 0A listens, and has none."""
_ESTABLISHED: Final = re.compile(
    rb"^ *\d+: \S+ ([0-9A-F]+):([0-9A-F]{4}) 01 (?:\S+ +){5}(\d+)", re.MULTILINE
)
"""Other address and port, and the socket's number."""


class _Sample(NamedTuple):
    t_ns: int
    turned_away: int
    connections: frozenset[tuple[bytes, bytes, bytes]]
    """Own port, other address and its port, as /proc has them."""


class Arrivals:
    """Connections to some ports of this host, between two looks."""

    def __init__(self, ports: Collection[int], proc_net: Path = _PROC_NET) -> None:
        """Look for the first time, at the ports of this host's services."""
        self._ports = {b"%04X" % port for port in ports}
        self._proc_net = proc_net
        self._last: _Sample | None = None

    def flood(self, now_ns: int) -> str:
        """Return who floods the ports since the last call, in words; empty if nobody does."""
        if not self._ports:
            return ""
        last, now = self._last, self._sample(now_ns)
        self._last = now
        if last is None or now.t_ns <= last.t_ns:
            return ""
        turned_away = (now.turned_away - last.turned_away) * NS_PER_S / (now.t_ns - last.t_ns)
        if turned_away < FLOOD_HZ:
            return ""
        begun = Counter(address for _, address, _ in now.connections - last.connections)
        whom = ", ".join(f"{_address(text)} ({count})" for text, count in begun.most_common(3))
        who = f"connections begun by {whom}" if whom else "nobody seen at the bus's ports"
        return f"flood: {turned_away:.0f} connections/s to this host turned away; {who}"

    def _sample(self, now_ns: int) -> _Sample:
        text = b"".join(self._read(name) for name in _TCP)
        rows = _ROW.findall(text)
        return _Sample(
            now_ns, self._turned_away(), frozenset(r for r in rows if r[0] in self._ports)
        )

    def _turned_away(self) -> int:
        rows = [line.split() for line in self._read("netstat").splitlines()]
        for names, values in zip(rows[::2], rows[1::2], strict=False):
            if names[0] == b"TcpExt:" and b"ListenDrops" in names:
                return int(values[names.index(b"ListenDrops")])
        return 0

    def _read(self, name: str) -> bytes:
        try:
            return (self._proc_net / name).read_bytes()
        except OSError:  # a kernel without IPv6
            return b""


def established(inodes: Collection[int], proc_net: Path = _PROC_NET) -> set[tuple[str, int]]:
    """Return the other ends, numeric address and port, of TCP connections by their sockets."""
    text = b"".join((proc_net / name).read_bytes() for name in _TCP if (proc_net / name).exists())
    return {
        (str(_address(address)), int(port, 16))
        for address, port, inode in _ESTABLISHED.findall(text)
        if int(inode) in inodes
    }


def _address(text: bytes) -> IpAddress:
    """Return an address of /proc/net/tcp: words of 32 bits in the order of this machine."""
    words = bytes.fromhex(text.decode())
    packed = b"".join(struct.pack(">I", word) for (word,) in struct.iter_unpack("=I", words))
    address = ipaddress.ip_address(packed)
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return mapped or address
