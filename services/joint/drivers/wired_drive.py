"""A module's drive, in motor turns from the joint's zero and with the motors' signs.

The encoders are on the motors, and the drive counts their turns from 0 after each power cycle. So
`xrl drive zero` writes the joint's position plus `mark_turns` to the drive: a motor at q = 0 reads
`mark_turns`. After a power cycle the drive reads near 0 instead, so a lost zero is detected within
one cycle: the drive is `UNZEROED` and never armed, and an armed drive faults. A failed encoder
keeps reporting its last position; the drive's error shows the failure.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from services.joint.drivers.base import Drive, DriveReading, MotorTarget
from shared.bus.messages import LOST_DRIVE, DriveStatus, Pair
from shared.rounding import RATE, TURNS, rounded

Signs = tuple[int, int]
"""Signs of axis0 and axis1; -1 if the motor counts down where the differential counts up."""


class MotorFrame(NamedTuple):
    """Conversion between the drive's counts and motor turns from the joint's zero."""

    mark_turns: float = 0.0
    """Reading of a motor at q = 0; with 0, any drive counts as zeroed."""
    signs: Signs = (1, 1)

    def from_drive(self, reading: DriveReading) -> DriveReading:
        """Return a reading in turns from the joint's zero; its status is UNZEROED without a zero.

        A driver may return NumPy scalars, which are converted to `float` here: they are slow, may
        compute in single precision, and must not be in a message.
        """
        mark, (sign_a, sign_b) = self
        (a, b), (vel_a, vel_b), torque = reading.pos_turns, reading.vel_turns, reading.torque
        a, b = float(a) * sign_a - mark, float(b) * sign_b - mark
        status, half, zero = reading.status, 0.5 * mark, reading.encoder_zero
        zeroed = mark == 0.0 or (-half < a < half and -half < b < half)
        if not zeroed and status not in LOST_DRIVE:
            status = DriveStatus.UNZEROED
        return DriveReading(
            int(reading.t_ns),
            rounded((a, b), TURNS),
            rounded((float(vel_a) * sign_a, float(vel_b) * sign_b), RATE),
            status,
            int(reading.error),
            None if torque is None else self.torque((float(torque[0]), float(torque[1]))),
            None
            if zero is None
            else ((float(zero[0]) * sign_a - mark) % 1.0, (float(zero[1]) * sign_b - mark) % 1.0),
            _floats(reading.fet_celsius),
            _floats(reading.motor_celsius),
            supply_v=float(reading.supply_v),
        )

    def target(self, target: MotorTarget) -> MotorTarget:
        """Return a target in the drive's counts and signs."""
        mark, (sign_a, sign_b) = self
        (a, b), (vel_a, vel_b) = target.pos_turns, target.vel_turns
        torque_a, torque_b = target.torque
        return MotorTarget(
            ((a + mark) * sign_a, (b + mark) * sign_b),
            (vel_a * sign_a, vel_b * sign_b),
            (torque_a * sign_a, torque_b * sign_b),
            target.pos_gain,
            target.vel_gain,
        )

    def position(self, turns: Pair) -> Pair:
        """Convert motor turns from the joint's zero to the drive's count."""
        mark, (sign_a, sign_b) = self
        return ((turns[0] + mark) * sign_a, (turns[1] + mark) * sign_b)

    def torque(self, torque: Pair) -> Pair:
        """Convert motor torques, N m, to or from the signs of the drive."""
        return (torque[0] * self.signs[0], torque[1] * self.signs[1])


def _floats(pair: Pair | None) -> Pair | None:
    return None if pair is None else (float(pair[0]), float(pair[1]))


class WiredDrive:
    """A drive behind its motor frame; implements `Drive`.

    With `read_only`, for bring-up and beside another controller, the drive gets no commands, only
    requests for values. An armed drive then belongs to another controller and reads as IDLE. So the
    service stays DISARMED and only publishes the joint's position and the drive's errors.
    """

    def __init__(self, drive: Drive, frame: MotorFrame, *, read_only: bool = False) -> None:
        self._drive = drive
        self._frame = frame
        self._read_only = read_only

    def read(self, timeout_s: float) -> DriveReading | None:
        """See `Drive.read`."""
        raw = self._drive.read(timeout_s)
        if raw is None:
            return None
        reading = self._frame.from_drive(raw)
        if not self._read_only or reading.status is not DriveStatus.ARMED:
            return reading
        return msgspec.structs.replace(reading, status=DriveStatus.IDLE, torque=None)

    def write_torque(self, torque: Pair) -> None:
        """See `Drive.write_torque`."""
        if not self._read_only:
            self._drive.write_torque(self._frame.torque(torque))

    def write(self, target: MotorTarget) -> None:
        """See `Drive.write`."""
        if not self._read_only:
            self._drive.write(self._frame.target(target))

    def arm(self, *, onboard: bool) -> None:
        """See `Drive.arm`."""
        if not self._read_only:
            self._drive.arm(onboard=onboard)

    def clear_errors(self) -> None:
        """See `Drive.clear_errors`."""
        if not self._read_only:
            self._drive.clear_errors()

    def idle(self) -> None:
        """See `Drive.idle`."""
        if not self._read_only:
            self._drive.idle()

    def set_position(self, turns: Pair) -> None:
        """Zero both motors by writing their turns from the joint's zero."""
        if not self._read_only:
            self._drive.set_position(self._frame.position(turns))

    def close(self) -> None:
        """See `Drive.close`."""
        self._drive.close()
