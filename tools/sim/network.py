"""Modelled network links, seeded, with the scenario's impairments (docs/architecture.md). Pure.

A link's own impairment and those of `xrl sim --inject` use `shared.config.impairment`, as the
network proxy of a live fleet does. A modelled link has no lease and is never redialled, so a stream
delivers everything that a partition held back, however long the partition lasted.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, TypeVar

from shared.bus.codec import encode
from shared.bus.messages import Message
from shared.bus.traces import LinkEvent
from shared.config.impairment import HELD, Direction, Impairer, Impairment
from shared.config.scenarios import Inject
from shared.links import DIRECTIONS
from shared.network.impairment_schedule import ImpairmentSchedule

M = TypeVar("M", bound=Message)

BASE: Final = Impairment(delay_ms=1.0)
"""Impairment of every link, each way, by default."""
OVERHEAD_BYTES: Final = 40
"""Size of the key and header that are sent with a payload."""


class VirtualLink(Generic[M]):
    """One direction between two processes; the receiver stores only the newest arrival.

    A message that arrives after one that was sent later is dropped, as Zenoh does with its own
    sequence numbers.
    """

    def __init__(self, base: Impairment, name: str, seed: int) -> None:
        """Start empty with the link's own impairment `base`; `name` is one of `shared.links`."""
        self.direction = Direction(name, seed)
        self.overtaken = 0
        """Number of messages that arrived too late, or twice, and were dropped."""
        self._base = Impairer(base, f"{seed} {name} base")
        self._queue: list[tuple[int, int, M]] = []  # by arrival
        self._held: list[tuple[int, M]] = []
        self._sent = self._newest = 0
        self._stream_ns = 0
        """Time at which the last message of a stream passes; until then all others wait for it."""

    def put(self, now_ns: int, message: M) -> None:
        """Send a message."""
        self._sent += 1
        if self.direction.active is None and now_ns >= self._stream_ns:  # the usual case
            self._enter(now_ns, self._sent, message)
            return
        for release_ns in self.direction.passes(now_ns, self._size(message)):
            if release_ns == HELD:
                self._held.append((self._sent, message))
            else:
                self._enter(self._behind(now_ns, release_ns), self._sent, message)

    def take(self, now_ns: int) -> M | None:
        """Return the newest message since the last call, or None, like a ring of depth 1."""
        newest = None
        while self._queue and self._queue[0][0] <= now_ns:
            _, number, message = heapq.heappop(self._queue)
            if number > self._newest:
                self._newest, newest = number, message
            else:
                self.overtaken += 1
        return newest

    def release(self, now_ns: int) -> None:
        """Release the messages that an ended partition held back, in order and with their delay."""
        if not self._held:
            return
        impairer = self.direction.active
        release_ns = now_ns if impairer is None else impairer.delays(now_ns)
        if release_ns == HELD:
            return
        release_ns = self._stream_ns = max(release_ns, self._stream_ns)
        held, self._held = self._held, []
        for number, message in held:
            self._enter(release_ns, number, message)

    def _behind(self, now_ns: int, release_ns: int) -> int:
        """Return when a message passes, not before messages that still wait on a stream.

        This applies even if the impairment under which those were sent has ended.
        """
        if now_ns < self._stream_ns:
            release_ns = max(release_ns, self._stream_ns)
        impairer = self.direction.active
        if impairer is not None and impairer.what.ordered:
            self._stream_ns = release_ns
        return release_ns

    def _enter(self, now_ns: int, number: int, message: M) -> None:
        for arrival_ns in self._base.passes(now_ns, 0):
            heapq.heappush(self._queue, (arrival_ns, number, message))

    def _size(self, message: M) -> int:
        impairer = self.direction.active
        if impairer is None or not impairer.what.rate:
            return 0
        return len(encode(message)) + OVERHEAD_BYTES


class VirtualNetwork:
    """All links.

    Attributes:
        links: by direction, as named in `shared.links`.
    """

    def __init__(
        self,
        base: Impairment,
        injects: Sequence[Inject],
        seed: int,
        record: Callable[[LinkEvent], None],
    ) -> None:
        """Start the links with the impairment `base`; `injects` are further, timed impairments.

        `record` is called with an event whenever one of `injects` starts or ends.
        """
        self.links: dict[str, VirtualLink[Any]] = {
            name: VirtualLink(base, name, seed) for name in DIRECTIONS
        }
        self._injections = ImpairmentSchedule(
            {name: link.direction for name, link in self.links.items()}, record
        )
        for inject in sorted(injects, key=lambda inject: inject.at):
            self._injections.plan(inject.link, inject, inject.at, inject.until)

    def advance(self, scenario_s: float, now_ns: int) -> None:
        """Start and end impairments that are due; release messages held by an ended partition."""
        if self._injections.advance(scenario_s, now_ns):
            for link in self.links.values():
                link.release(now_ns)

    def cut(self, link: str, for_s: float, scenario_s: float, now_ns: int) -> None:
        """Cut links of `shared.links` for `for_s` seconds, as requested by a person who watches."""
        self._injections.begin(link, Impairment(partition=True), scenario_s + for_s, now_ns)

    def active(self, scenario_s: float) -> tuple[str, ...]:
        """Return the impairments that are active at a scenario time, in words."""
        return tuple(
            f"{row.link}: {row.what.describe()}"
            for row in self._injections.requested.values()
            if row.begins <= scenario_s
        )

    def end(self, now_ns: int) -> None:
        """End all impairments at the end of a run, so that their counts are recorded."""
        self._injections.clear("all", now_ns)
