"""A drive that is only listened to: for bring-up, and beside whoever else controls it."""

from __future__ import annotations

import msgspec

from services.joint.drivers.base import Drive, DriveReading, DriveStatus, MotorTarget
from shared.messages import Pair


class ReadOnly:
    """A drive that nothing is sent to; implements `Drive`.

    It never looks armed, so its service stays DISARMED: it publishes where the joint is and
    what the drive reports, and takes no command.
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = drive

    def read(self, timeout_s: float) -> DriveReading | None:
        """See `Drive.read`; an armed drive is somebody else's, and IDLE to us."""
        reading = self._drive.read(timeout_s)
        if reading is None or reading.status is not DriveStatus.ARMED:
            return reading
        return msgspec.structs.replace(reading, status=DriveStatus.IDLE, torque=None)

    def write_torque(self, torque: Pair) -> None:
        """Do nothing."""

    def write(self, target: MotorTarget) -> None:
        """Do nothing."""

    def arm(self, *, onboard: bool) -> None:
        """Do nothing."""

    def idle(self) -> None:
        """Do nothing."""

    def set_position(self, turns: Pair) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Release the link."""
        self._drive.close()
