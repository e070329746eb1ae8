"""Clocks of hosts in virtual time: each has its own zero and rate. Pure.

Live, a service reads its host's monotonic clock. That one cannot step, whatever is done to the time
of day, but no two hosts agree on it: an age is measured on one clock only
(docs/architecture.md#age-rule).
"""

from __future__ import annotations

from typing import Generic, TypeVar

from shared.bus.messages import Message
from tools.sim.network import VirtualLink

M = TypeVar("M", bound=Message)


class HostClock:
    """The monotonic clock of one host."""

    def __init__(self, offset_ns: int = 0, drift_ppm: float = 0.0) -> None:
        """Begin.

        Args:
            offset_ns: ahead of virtual time at its zero.
            drift_ppm: so much too fast, in millionths.
        """
        self.offset_ns = offset_ns
        self.drift_ppm = drift_ppm

    def read(self, now_ns: int) -> int:
        """Return the host's time at a virtual time, ns."""
        drift_ns = round(now_ns * self.drift_ppm * 1e-6) if self.drift_ppm else 0
        return now_ns + self.offset_ns + drift_ns

    def step(self, by_ns: int) -> None:
        """Step the clock, which a monotonic clock never does."""
        self.offset_ns += by_ns


class HostLink(Generic[M]):
    """A link as a process sees it that knows its own host's time only."""

    def __init__(self, link: VirtualLink[M]) -> None:
        """Take the link, which is in virtual time."""
        self._link = link
        self.now_ns = 0
        """Virtual time; set before the process runs."""

    def put(self, _host_ns: int, message: M) -> None:
        """Send, whatever the host takes for the time."""
        self._link.put(self.now_ns, message)
