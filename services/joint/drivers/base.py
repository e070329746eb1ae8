"""The one interface of all drives (docs/drives.md)."""

from __future__ import annotations

from typing import Protocol

import msgspec

from shared.bus.messages import DriveStatus, Pair

__all__ = ["Drive", "DriveReading", "DriveStatus", "MotorTarget"]


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
