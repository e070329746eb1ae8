"""ZeroMQ: PUB and SUB over ipc, a socket for each key; CONFLATE keeps the newest."""

from __future__ import annotations

from pathlib import Path

import zmq

from tools.lab.bench.transports.base import Put, Take


class OverZmq:
    """Sockets of one process."""

    def __init__(self, folder: Path) -> None:
        """Take the folder."""
        self._folder, self._context = folder, zmq.Context()

    def publisher(self, key: str) -> Put:
        """See `Transport.publisher`."""
        end = self._context.socket(zmq.PUB)
        end.bind(self._address(key))
        return lambda payload: end.send(payload, zmq.NOBLOCK)

    def latest(self, key: str) -> Take:
        """See `Transport.latest`."""
        end = self._context.socket(zmq.SUB)
        end.setsockopt(zmq.CONFLATE, 1)
        end.setsockopt(zmq.SUBSCRIBE, b"")
        end.connect(self._address(key))

        def take() -> bytes | None:
            try:
                return bytes(end.recv(zmq.NOBLOCK))
            except zmq.Again:
                return None

        return take

    def close(self) -> None:
        """Leave."""
        self._context.destroy(linger=0)

    def _address(self, key: str) -> str:
        return f"ipc://{self._folder / key.replace('/', '.')}"


def open_transport(_process: str, folder: Path) -> OverZmq:
    """Join the sockets in a folder."""
    return OverZmq(folder)
