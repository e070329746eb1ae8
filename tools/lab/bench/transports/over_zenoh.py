"""Zenoh as the fleet uses it: peers, fixed endpoints, one ring of depth 1 for each key."""

from __future__ import annotations

from pathlib import Path

from shared.bus.session import Session, open_session
from shared.config import files as config_file
from shared.places import DEFAULT_CONFIG
from tools.lab.bench.transports.base import Put, Take


class OverZenoh:
    """A session of the fleet's own bus."""

    def __init__(self, session: Session) -> None:
        """Take the session."""
        self._session = session

    def publisher(self, key: str) -> Put:
        """See `Transport.publisher`."""
        return self._session.raw_publisher(f"bench/{key}", patient=False).put

    def latest(self, key: str) -> Take:
        """See `Transport.latest`."""
        stream = self._session.stream([f"bench/{key}"], capacity=1)

        def take() -> bytes | None:
            sample = stream.take()
            return None if sample is None else sample[1]

        return take

    def close(self) -> None:
        """Leave."""
        self._session.close()


def open_transport(process: str, folder: Path) -> OverZenoh:
    """Join the bus in a folder."""
    return OverZenoh(open_session(config_file.load(DEFAULT_CONFIG), process, folder))
