"""Motors that count the other way round, as those of a mirrored leg do."""

from __future__ import annotations

from services.joint.drivers.base import Drive, DriveReading, MotorTarget
from shared.messages import Pair

Signs = tuple[int, int]
"""Of axis0 and axis1, 1 or -1."""


def signed_reading(reading: DriveReading, signs: Signs) -> DriveReading:
    """Return a reading with both motors counting as the differential takes them."""
    return DriveReading(
        reading.t_ns,
        _times(reading.pos_turns, signs),
        _times(reading.vel_turns, signs),
        reading.status,
        reading.error,
        None if reading.torque is None else _times(reading.torque, signs),
    )


def signed_target(target: MotorTarget, signs: Signs) -> MotorTarget:
    """Return a target as the motors count."""
    return MotorTarget(
        _times(target.pos_turns, signs),
        _times(target.vel_turns, signs),
        _times(target.torque, signs),
        target.pos_gain,
        target.vel_gain,
    )


class Signed:
    """A drive whose motors have signs; implements `Drive`."""

    def __init__(self, drive: Drive, signs: Signs) -> None:
        """Take the robot file's `motor_signs` of its module."""
        self._drive = drive
        self._signs = signs

    def read(self, timeout_s: float) -> DriveReading | None:
        """See `Drive.read`."""
        reading = self._drive.read(timeout_s)
        return None if reading is None else signed_reading(reading, self._signs)

    def write_torque(self, torque: Pair) -> None:
        """See `Drive.write_torque`."""
        self._drive.write_torque(_times(torque, self._signs))

    def write(self, target: MotorTarget) -> None:
        """See `Drive.write`."""
        self._drive.write(signed_target(target, self._signs))

    def arm(self, *, onboard: bool) -> None:
        """See `Drive.arm`."""
        self._drive.arm(onboard=onboard)

    def idle(self) -> None:
        """See `Drive.idle`."""
        self._drive.idle()

    def set_position(self, turns: Pair) -> None:
        """See `Drive.set_position`."""
        self._drive.set_position(_times(turns, self._signs))

    def close(self) -> None:
        """See `Drive.close`."""
        self._drive.close()


def _times(pair: Pair, signs: Signs) -> Pair:
    return (pair[0] * signs[0], pair[1] * signs[1])
