"""Virtual time, as each process sees it: by its host's clock, and through its links.

Live, a service reads its host's monotonic clock. That one cannot step, whatever is done to the time
of day, but no two hosts agree on it: an age is measured on one clock only
(docs/architecture.md#age-rule).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from shared.bus.messages import Message
from shared.bus.topics import Topic
from tools.sim.network import VirtualLink

M = TypeVar("M", bound=Message)

Record = Callable[[Topic, str, Message], None]
"""Takes what live would be on the bus: topic, module or "", message."""


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


class VirtualTime:
    """The time of a run, which all its processes share and none of them knows."""

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns

    def on(self, clock: HostClock) -> Callable[[], int]:
        """Return a host's clock, to be read now."""
        return lambda: clock.read(self.now_ns)


class LinkInbox(Generic[M]):
    """The receiving end of a link: an `Inbox`."""

    refused = 0

    def __init__(self, link: VirtualLink[M], time: VirtualTime) -> None:
        self._link, self._time = link, time

    def take(self) -> M | None:
        """Return the newest message that has arrived and was not taken before."""
        return self._link.take(self._time.now_ns)


class RecordOutbox(Generic[M]):
    """The sending end of a link, if anybody listens, and of the record: an `Outbox`."""

    def __init__(
        self,
        record: Record,
        topic: Topic,
        module: str = "",
        link: VirtualLink[M] | None = None,
        time: VirtualTime | None = None,
    ) -> None:
        self._record, self._topic, self._module = record, topic, module
        self._link, self._time = link, time

    def put(self, message: M, /) -> bool:
        """Send and record."""
        if self._link is not None and self._time is not None:
            self._link.put(self._time.now_ns, message)
        self._record(self._topic, self._module, message)
        return True
