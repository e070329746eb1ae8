"""Loop of the IMU service: reads the sensor, computes the up direction and publishes it."""

from __future__ import annotations

from services.imu.attitude import AttitudeLaw
from shared.bus.messages import Attitude
from shared.bus.ports import Outbox
from shared.can.sensor_frames import ImuSample
from shared.can.sensor_loop import Sensor, SensorLoop


class ImuLoop(SensorLoop[ImuSample, Attitude]):
    """Loop of the IMU service."""

    def __init__(
        self, sensor: Sensor[ImuSample], law: AttitudeLaw, publisher: Outbox[Attitude]
    ) -> None:
        super().__init__(sensor, publisher)
        self._law = law

    @property
    def refused(self) -> int:
        """Number of samples whose quaternion was not of unit length."""
        return self._law.refused

    def message(self, now_ns: int, sample: ImuSample | None) -> Attitude:
        """Return the message with the up direction and the angular velocity."""
        reading = self._law.step(now_ns, sample)
        return Attitude(t_ns=now_ns, seq=self.cycles, **reading._asdict())
