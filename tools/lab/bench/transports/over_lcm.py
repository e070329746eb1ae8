"""LCM: UDP multicast with a time to live of 0, so it stays on this host."""

from __future__ import annotations

import zlib
from pathlib import Path

import lcm

from tools.lab.bench.transports.base import Put, Take

_FIRST_PORT = 20_000
_PORTS = 20_000


class OverLcm:
    """An LCM on a port of the folder's own."""

    def __init__(self, folder: Path) -> None:
        """Open the port."""
        port = _FIRST_PORT + zlib.crc32(str(folder).encode()) % _PORTS
        self._lcm = lcm.LCM(f"udpm://239.255.76.67:{port}?ttl=0")
        self._newest: dict[str, bytes] = {}

    def publisher(self, key: str) -> Put:
        """See `Transport.publisher`."""
        return lambda payload: self._lcm.publish(key, payload)

    def latest(self, key: str) -> Take:
        """See `Transport.latest`."""
        self._lcm.subscribe(key, self._receive)

        def take() -> bytes | None:
            while self._lcm.handle_timeout(0):
                pass
            return self._newest.pop(key, None)

        return take

    def close(self) -> None:
        """Leave: the socket ends with the process."""

    def _receive(self, key: str, payload: bytes) -> None:
        self._newest[key] = payload


def open_transport(_process: str, folder: Path) -> OverLcm:
    """Join the port of a folder."""
    return OverLcm(folder)
