"""Loop of a service that reads a sensor, on the caller's clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, Protocol, TypeVar

from shared.bus.messages import Message
from shared.bus.ports import Outbox

S = TypeVar("S")
S_co = TypeVar("S_co", covariant=True)
M = TypeVar("M", bound=Message)


class Sensor(Protocol[S_co]):
    """Source of a sensor's samples."""

    def newest(self, now_ns: int, /) -> S_co | None:
        """Return the newest sample that arrived since the last call, or None; never blocks.

        Never raises for a lost link; returns None until it is back.
        """


class SensorLoop(ABC, Generic[S, M]):
    """One cycle: read, make a message, publish.

    Attributes:
        cycles: number of cycles so far.
        skipped: missed deadlines, whose cycles were left out.
        unsent: messages that the bus did not accept.
    """

    def __init__(self, sensor: Sensor[S], publisher: Outbox[M]) -> None:
        self.cycles = self.skipped = self.unsent = 0
        self._sensor, self._publisher = sensor, publisher

    @property
    @abstractmethod
    def refused(self) -> int:
        """Number of implausible samples so far."""

    @abstractmethod
    def message(self, now_ns: int, sample: S | None) -> M:
        """Return the message to publish; `sample` is None if no new one arrived."""

    def cycle(self, now_ns: int) -> M:
        """Run once; return the published message."""
        message = self.message(now_ns, self._sensor.newest(now_ns))
        self.unsent += not self._publisher.put(message)
        self.cycles += 1
        return message
