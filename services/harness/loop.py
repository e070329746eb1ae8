"""The loop of the harness service: read, tare on request, filter, publish."""

from __future__ import annotations

from typing import Protocol

from services.harness import filter as wrench_filter
from services.harness.filter import FilterState, WrenchFilter
from shared.bus.messages import TareRequest, Vector6, Wrench


class HarnessSensor(Protocol):
    """Six load cells."""

    def newest(self, now_ns: int, /) -> Vector6 | None:
        """Return the leg forces that came since the last call, N, or None; never blocks.

        Never raises for a lost link: that is None until it is back.
        """


class WrenchPublisher(Protocol):
    """Where the wrench goes."""

    def put(self, message: Wrench) -> bool:
        """Send without waiting; False if it could not be sent."""


class TareRequests(Protocol):
    """Where requests for a tare come from."""

    def take(self) -> TareRequest | None:
        """Return the newest request that came since the last call, or None; never blocks."""


class HarnessLoop:
    """One cycle of the service, on whatever clock it is called with; begins with a tare."""

    def __init__(
        self,
        sensor: HarnessSensor,
        law: WrenchFilter,
        publisher: WrenchPublisher,
        requests: TareRequests,
    ) -> None:
        self.state: FilterState = wrench_filter.initial_state()
        self.cycles = 0
        self.skipped = 0
        """Deadlines that were missed and not made up for."""
        self.unsent = 0
        self._sensor, self._law = sensor, law
        self._publisher, self._requests = publisher, requests

    @property
    def refused(self) -> int:
        """Samples that were not finite."""
        return self.state.refused

    def cycle(self, now_ns: int) -> Wrench:
        """Read, tare on request, filter, publish; return the published message.

        The wrench is in torso axes: the sensor is fixed to the torso.
        """
        forces = self._sensor.newest(now_ns)
        if self._requests.take() is not None:
            self.state = wrench_filter.start_tare(self.state)
        self.state, reading = self._law.step(self.state, now_ns, forces)
        fx, fy, fz, mx, my, mz = reading.wrench.tolist()
        message = Wrench(
            t_ns=now_ns,
            seq=self.cycles,
            force=(fx, fy, fz),
            moment=(mx, my, mz),
            valid=reading.valid,
            saturated=reading.saturated,
            tare=int(self.state.tare),
            age_ns=reading.age_ns,
        )
        self.unsent += not self._publisher.put(message)
        self.cycles += 1
        return message
