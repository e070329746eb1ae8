"""The load-cell amplifier on its CAN bus: the newest sample, without waiting for it."""

from __future__ import annotations

from typing import Protocol

from shared.bus.messages import Vector6
from shared.can.can_sensor import CanSensor
from shared.can.loadcell_can import LegSample, SampleAssembler


class HarnessSensor(Protocol):
    """Six load cells."""

    def read(self, now_ns: int) -> LegSample | None:
        """Return the newest sample that came since the last read, or None; never blocks.

        Never raises for a lost link: that is None until it is back.
        """

    def close(self) -> None:
        """Release the link."""


class CanHarnessSensor(CanSensor[Vector6]):
    """`HarnessSensor` through python-can."""

    def __init__(self, interface: str, channel: str, *, pause_ns: int) -> None:
        """Prepare; arguments and errors are those of `CanSensor`."""
        super().__init__(interface, channel, SampleAssembler(), pause_ns=pause_ns)

    def read(self, now_ns: int) -> LegSample | None:
        """Return the newest sample that came since the last read, stamped `now_ns`."""
        forces = self.newest(now_ns)
        return None if forces is None else LegSample(now_ns, forces)
