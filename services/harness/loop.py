"""The loop of the harness service: read, tare on request, filter, publish."""

from __future__ import annotations

from services.harness.filter import FilterState, WrenchFilter, start_tare, tared_state
from services.harness.zero_file import ZeroFile
from shared.bus.messages import Tare, TareRequest, Vector6, Wrench
from shared.bus.ports import Inbox, Outbox
from shared.can.sensor_loop import Sensor, SensorLoop


class HarnessLoop(SensorLoop[Vector6, Wrench]):
    """One cycle of the service; begins with a tare, or with the zero of the service before it."""

    def __init__(
        self,
        sensor: Sensor[Vector6],
        law: WrenchFilter,
        publisher: Outbox[Wrench],
        requests: Inbox[TareRequest],
        zero: ZeroFile | None = None,
    ) -> None:
        super().__init__(sensor, publisher)
        self._law, self._requests, self._zero = law, requests, zero
        kept = None if zero is None else zero.read()
        self.state = FilterState() if kept is None else tared_state(kept)
        self._kept = kept is not None

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
        done = self.state.tare is Tare.DONE
        if self._zero is not None and done is not self._kept:
            self._kept = done
            self._zero.write(self.state.offset if done else None)
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
