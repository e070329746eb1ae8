"""The loop of a service that reads a sensor, on whatever clock it is called with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, Protocol, TypeVar

from shared.bus.messages import Message
from shared.bus.ports import Outbox

S = TypeVar("S")
S_co = TypeVar("S_co", covariant=True)
M = TypeVar("M", bound=Message)


class Sensor(Protocol[S_co]):
    """Where a sensor's samples come from."""

    def newest(self, now_ns: int, /) -> S_co | None:
        """Return the newest sample that came since the last call, or None; never blocks.

        Never raises for a lost link: that is None until it is back.
        """


class SensorLoop(ABC, Generic[S, M]):
    """One cycle: read, make a message of it, publish.

    Attributes:
        cycles: so far.
        skipped: deadlines that were missed and not made up for.
        unsent: messages that the bus did not take.
    """

    def __init__(self, sensor: Sensor[S], publisher: Outbox[M]) -> None:
        self.cycles = self.skipped = self.unsent = 0
        self._sensor, self._publisher = sensor, publisher

    @property
    @abstractmethod
    def refused(self) -> int:
        """Samples that no sensor can have measured."""

    @abstractmethod
    def message(self, now_ns: int, sample: S | None) -> M:
        """Return what is to be published for the newest sample, None if there is none."""

    def cycle(self, now_ns: int) -> M:
        """Run once; return the published message."""
        message = self.message(now_ns, self._sensor.newest(now_ns))
        self.unsent += not self._publisher.put(message)
        self.cycles += 1
        return message
