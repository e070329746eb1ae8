"""Interface of all drives (docs/drives.md)."""

from __future__ import annotations

import math
from typing import Final, Protocol

import msgspec

from shared.bus.messages import DriveStatus, Pair
from shared.clock import NS_PER_S

__all__ = [
    "HEAT_EVERY_NS", "SUPPLY_EVERY_NS", "Drive", "DriveReading", "DriveStatus", "MotorTarget",
    "is_target", "real_readings",
]  # fmt: skip

HEAT_EVERY_NS: Final = NS_PER_S
"""Period of temperature requests to the drive, ns, if its firmware reports temperatures."""
SUPPLY_EVERY_NS: Final = NS_PER_S // 2
"""Period of requests for the supply's voltage, ns."""
LARGEST: Final = 1e9
"""Largest target, in any unit; single precision loses all fractions long before that."""
CELSIUS: Final = (-40.0, 200.0)
"""Valid readings of a thermistor, C; a pin without one reads 0 or an arbitrary value."""


def real_readings(first: float, second: float) -> Pair | None:
    """Return the thermistor readings of both axes, C; None unless both are valid."""
    low, high = CELSIUS
    both = (first, second)
    real = all(math.isfinite(one) and low < one < high and one != 0.0 for one in both)
    return both if real else None


class DriveReading(msgspec.Struct, gc=False, frozen=True):
    """Sample of both axes of a module, at the motors."""

    t_ns: int
    """Monotonic time at which the later of the two encoder frames arrived."""
    pos_turns: Pair
    vel_turns: Pair
    """turn/s"""
    status: DriveStatus
    error: int
    """Error bits of both axes, or-ed."""
    torque: Pair | None = None
    """Torque of the motors' own loops, N m; known only while a drive that was found armed waits for
    its take-over."""
    encoder_zero: Pair | None = None
    """Positions at which the encoders' angles within the turn are 0, turns modulo one; None unless
    the drive has just reported them. `Drive.set_position` changes them."""
    fet_celsius: Pair | None = None
    """Thermistor readings of the output stages, C; None without new ones."""
    motor_celsius: Pair | None = None
    """Thermistor readings of the motors, C; None without new ones or without thermistors."""
    supply_v: float = 0.0
    """Last reported voltage of the drive's supply, V; 0 if unknown."""

    @property
    def angles(self) -> Pair | None:
        """Angles of both encoders within their motors' turns, as fractions of a turn.

        None without new values. Absolute encoders keep the angles without power. For a turning
        motor, the angles are as old as the estimate.
        """
        zero = self.encoder_zero
        if zero is None:
            return None
        return (self.pos_turns[0] - zero[0]) % 1.0, (self.pos_turns[1] - zero[1]) % 1.0


class MotorTarget(msgspec.Struct, gc=False, frozen=True):
    """Target of both motors' own loops, axis0 and axis1 (docs/drives.md).

    The law is torque + vel_gain (clamp(vel_turns + pos_gain (pos_turns - pos)) - vel).
    """

    pos_turns: Pair
    vel_turns: Pair
    """turn/s"""
    torque: Pair
    """Feedforward, N m at the motor."""
    pos_gain: Pair
    """1/s"""
    vel_gain: Pair
    """N m s/turn"""


def is_target(target: MotorTarget) -> bool:
    """Return True if every field is a number that drives accept over CAN and USB."""
    for first, second in (
        target.pos_turns,
        target.vel_turns,
        target.torque,
        target.pos_gain,
        target.vel_gain,
    ):
        if not (-LARGEST < first < LARGEST and -LARGEST < second < LARGEST):
            return False
    return True


class Drive(Protocol):
    """One ODrive: axis0 and axis1 of a module."""

    def read(self, timeout_s: float) -> DriveReading | None:
        """Wait for the next encoder sample of both axes; None if it does not arrive in time.

        Never raises for a lost link: the next reading is then None or has a `LOST_DRIVE` status.
        """

    def write_torque(self, torque: Pair) -> None:
        """Send motor torques in N m to axis0 and axis1, together; never blocks or raises."""

    def write(self, target: MotorTarget) -> None:
        """Send the target of both motors' own loops, together; never blocks or raises."""

    def arm(self, *, onboard: bool) -> None:
        """Request closed loop control on both axes; `status` shows when it is reached.

        Args:
            onboard: True for the motors' own position loop (`write`), with zero gains at first;
                False for torques only (`write_torque`).
        """

    def clear_errors(self) -> None:
        """Clear both axes' errors; a persistent error returns, an encoder's within 51 ms."""

    def idle(self) -> None:
        """Command both axes to go idle."""

    def set_position(self, turns: Pair) -> None:
        """Write both motors' positions, turns, while they are idle; may wait for the drive.

        Raises:
            DriveError: the drive does not accept them.
        """

    def close(self) -> None:
        """Release the link."""
