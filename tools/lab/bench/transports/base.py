"""What the bench needs of a transport, and which there are."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple, Protocol

Put = Callable[[bytes], object]
"""Sends a payload; never blocks."""
Take = Callable[[], "bytes | None"]
"""Returns the newest payload if it was not taken before; never blocks."""


class Transport(Protocol):
    """One process's end; keys are `state/MODULE` and `command/MODULE`."""

    def publisher(self, key: str) -> Put:
        """Return how to send on a key."""

    def latest(self, key: str) -> Take:
        """Return how to take a key's newest payload."""

    def close(self) -> None:
        """Leave."""


class TransportRow(NamedTuple):
    """One row of the table of transports."""

    name: str
    module: str
    """Module with `open_transport(process, folder)`."""
    package: str
    """Package that it needs; "" for none."""
    note: str


TRANSPORTS: Final = (
    TransportRow("zenoh", "over_zenoh", "zenoh", "as the fleet uses it: shared/bus/session.py"),
    TransportRow("datagrams", "over_datagrams", "", "UNIX datagrams, a socket for each key"),
    TransportRow("zmq", "over_zmq", "zmq", "PUB and SUB over ipc, CONFLATE"),
    TransportRow("iceoryx2", "over_iceoryx2", "iceoryx2", "shared memory, buffer of 1"),
    TransportRow("cyclonedds", "over_cyclonedds", "cyclonedds", "best effort, keep last 1, UDP"),
    TransportRow("lcm", "over_lcm", "lcm", "UDP multicast, not beyond this host"),
)


def installed() -> dict[str, TransportRow]:
    """Return the transports whose package is installed, by name."""
    return {
        row.name: row
        for row in TRANSPORTS
        if not row.package or importlib.util.find_spec(row.package) is not None
    }


def open_transport(name: str, process: str, folder: Path) -> Transport:
    """Join a transport.

    Args:
        name: of the transport.
        process: `planner` or a module.
        folder: that all processes of this run share, and no other run uses.
    """
    row = installed()[name]
    module = importlib.import_module(f"tools.lab.bench.transports.{row.module}")
    transport: Transport = module.open_transport(process, folder)
    return transport
