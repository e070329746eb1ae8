"""The loop of the harness service: read, tare on request, filter, publish."""

from __future__ import annotations

from services.harness.filter import FilterState, WrenchFilter, start_tare
from shared.bus.messages import TareRequest, Vector6, Wrench
from shared.bus.ports import Inbox, Outbox
from shared.can.sensor_loop import Sensor, SensorLoop


class HarnessLoop(SensorLoop[Vector6, Wrench]):
    """One cycle of the service; begins with a tare."""

    def __init__(
        self,
        sensor: Sensor[Vector6],
        law: WrenchFilter,
        publisher: Outbox[Wrench],
        requests: Inbox[TareRequest],
    ) -> None:
        super().__init__(sensor, publisher)
        self.state = FilterState()
        self._law, self._requests = law, requests

    @property
    def refused(self) -> int:
        """Samples that were not finite."""
        return self.state.refused

    def message(self, now_ns: int, sample: Vector6 | None) -> Wrench:
        """Tare on request and filter the leg forces, N; return the wrench in torso axes.

        The sensor is fixed to the torso.
        """
        if self._requests.take() is not None:
            self.state = start_tare(self.state)
        self.state, reading = self._law.step(self.state, now_ns, sample)
        fx, fy, fz, mx, my, mz = reading.wrench.tolist()
        return Wrench(
            t_ns=now_ns,
            seq=self.cycles,
            force=(fx, fy, fz),
            moment=(mx, my, mz),
            valid=reading.valid,
            saturated=reading.saturated,
            tare=int(self.state.tare),
            age_ns=reading.age_ns,
        )
