"""A modelled network link: delay, jitter and loss, seeded (design section 7). Pure."""

from __future__ import annotations

import heapq
import random
from typing import Generic, TypeVar

import msgspec

from shared.clock import NS_PER_MS

T = TypeVar("T")


class Impairment(msgspec.Struct, frozen=True, kw_only=True):
    """What every link does to what passes it, each way."""

    delay_ms: float = 1.0
    jitter_ms: float = 0.0
    """Uniform: a message takes delay +- jitter, at least nothing."""
    loss: float = 0.0
    """Probability that a message never comes."""


class Link(Generic[T]):
    """One direction between two processes; the receiver keeps the newest arrival only."""

    def __init__(self, impairment: Impairment, seed: str) -> None:
        self._impairment = impairment
        self._random = random.Random(seed)
        self._queue: list[tuple[int, int, T]] = []  # by arrival
        self._sent = 0

    def put(self, now_ns: int, message: T) -> None:
        """Send."""
        what = self._impairment
        self._sent += 1
        if what.loss and self._random.random() < what.loss:
            return
        delay_ms = what.delay_ms
        if what.jitter_ms:
            delay_ms = max(0.0, delay_ms + self._random.uniform(-what.jitter_ms, what.jitter_ms))
        arrival_ns = now_ns + round(delay_ms * NS_PER_MS)
        heapq.heappush(self._queue, (arrival_ns, self._sent, message))

    def take(self, now_ns: int) -> T | None:
        """Return the last message to have arrived, as a ring of depth 1 does; None if none."""
        newest = None
        while self._queue and self._queue[0][0] <= now_ns:
            newest = heapq.heappop(self._queue)[2]
        return newest
