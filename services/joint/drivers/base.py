"""The one interface of all drives (docs/drives.md)."""

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
"""How often a driver asks its drive for the temperatures, ns, where the firmware tells them."""
SUPPLY_EVERY_NS: Final = NS_PER_S // 2
"""Time between two questions for the supply's voltage, ns."""
LARGEST: Final = 1e9
"""Largest target, in any unit; beyond it a single float holds no fraction."""
CELSIUS: Final = (-40.0, 200.0)
"""What a thermistor that is there reads; a pin without one reads 0 or nonsense."""


def real_readings(first: float, second: float) -> Pair | None:
    """Return both axes' readings of a thermistor, C; None if one of them is no reading."""
    low, high = CELSIUS
    both = (first, second)
    real = all(math.isfinite(one) and low < one < high and one != 0.0 for one in both)
    return both if real else None


class DriveReading(msgspec.Struct, gc=False, frozen=True):
    """Both axes of a module at one moment, at the motors."""

    t_ns: int
    """Monotonic time at which the later of the two encoder frames arrived."""
    pos_turns: Pair
    vel_turns: Pair
    """turn/s"""
    status: DriveStatus
    error: int
    """Error bits of both axes, or-ed."""
    torque: Pair | None = None
    """Torque of the motors' own loops, N m; known while a drive that was found armed waits for its
    take-over."""
    encoder_zero: Pair | None = None
    """Where the encoders' angles within the turn are 0, turns modulo one, when the drive has just
    answered that; `drive.set_position` moves it."""
    fet_celsius: Pair | None = None
    """What the thermistors of the output stages read, C; None: not with this sample."""
    motor_celsius: Pair | None = None
    """What the motors' thermistors read, C; None: not with this sample, or there are none."""
    supply_v: float = 0.0
    """Voltage of the drive's supply as it was told last, V; 0: not known."""

    @property
    def angles(self) -> Pair | None:
        """Angles of both encoders within their motors' turns, turns from 0 to 1.

        None: not with this sample. Absolute encoders keep them without power. Of a motor that
        turns they are as old as the estimate.
        """
        zero = self.encoder_zero
        if zero is None:
            return None
        return (self.pos_turns[0] - zero[0]) % 1.0, (self.pos_turns[1] - zero[1]) % 1.0


class MotorTarget(msgspec.Struct, gc=False, frozen=True):
    """Target of both motors' own loops, axis0 and axis1 (docs/drives.md).

    torque + vel_gain (clamp(vel_turns + pos_gain (pos_turns - pos)) - vel), no integrator.
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
    """Return True if every field is a number that a drive can take, over CAN and USB."""
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
        """Wait for the next encoder sample of both axes; None if none came in time.

        Never raises for a lost link: that is `DriveStatus.LOST` in the next reading, or None.
        """

    def write_torque(self, torque: Pair) -> None:
        """Send motor torques in N m to axis0 and axis1, together; never blocks or raises."""

    def write(self, target: MotorTarget) -> None:
        """Send the target of both motors' own loops, together; never blocks or raises."""

    def arm(self, *, onboard: bool) -> None:
        """Request closed loop control on both axes; `status` shows when it is reached.

        Args:
            onboard: True for the motors' own position loop (`write`), with no gains at
                first; False for torques only (`write_torque`).
        """

    def clear_errors(self) -> None:
        """Clear both axes' errors; one that is still there comes back, an encoder's in 51 ms."""

    def idle(self) -> None:
        """Ask both axes to go idle."""

    def set_position(self, turns: Pair) -> None:
        """Write both motors' position, turns; only while they are idle.

        Raises:
            DriveError: the drive does not take it. Not for the control path.
        """

    def close(self) -> None:
        """Release the link."""
