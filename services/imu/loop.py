"""The loop of the IMU service: read, say which way is up, publish."""

from __future__ import annotations

from typing import Protocol

from services.imu.attitude import AttitudeLaw
from shared.bus.messages import Attitude
from shared.can.imu_can import ImuSample


class ImuSensor(Protocol):
    """An IMU that fuses by itself."""

    def newest(self, now_ns: int, /) -> ImuSample | None:
        """Return the newest sample that came since the last call, or None; never blocks.

        Never raises for a lost link: that is None until it is back.
        """


class AttitudePublisher(Protocol):
    """Where attitudes go."""

    def put(self, message: Attitude) -> bool:
        """Send without waiting; False if it could not be sent."""


class ImuLoop:
    """One cycle of the service, on whatever clock it is called with."""

    def __init__(self, sensor: ImuSensor, law: AttitudeLaw, publisher: AttitudePublisher) -> None:
        self.cycles = 0
        self.skipped = 0
        """Deadlines that were missed and not made up for."""
        self.unsent = 0
        self._sensor, self._law, self._publisher = sensor, law, publisher

    @property
    def refused(self) -> int:
        """Samples whose quaternion was not of unit length."""
        return self._law.refused

    def cycle(self, now_ns: int) -> Attitude:
        """Read, publish the vector up; return the published message."""
        reading = self._law.step(now_ns, self._sensor.newest(now_ns))
        message = Attitude(
            t_ns=now_ns,
            seq=self.cycles,
            up=reading.up,
            rate=reading.rate,
            valid=reading.valid,
            age_ns=reading.age_ns,
        )
        self.unsent += not self._publisher.put(message)
        self.cycles += 1
        return message
