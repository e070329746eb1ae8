"""The one interface of all drives (design section 5)."""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

import msgspec

from shared.messages import Pair


class DriveStatus(IntEnum):
    """What the joint service needs to know of its two axes together."""

    LOST = 0
    """No frames, or the link is down."""
    IDLE = 1
    """Both axes answer; at least one is not in closed loop, and neither reports an error."""
    ARMED = 2
    """Both axes are in closed loop."""
    ERROR = 3
    """At least one axis reports an error or left closed loop by itself."""


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


class Drive(Protocol):
    """One ODrive: axis0 and axis1 of a module."""

    def read(self, timeout_s: float) -> DriveReading | None:
        """Wait for the next encoder sample of both axes; None if none came in time.

        Never raises for a lost link: that is `DriveStatus.LOST` in the next reading,
        or None.
        """

    def write_torque(self, torque: Pair) -> None:
        """Send motor torques in N m to axis0 and axis1, together; never blocks or raises."""

    def arm(self) -> None:
        """Ask for closed loop torque control on both axes; `status` tells when it is so."""

    def idle(self) -> None:
        """Ask both axes to go idle."""

    def close(self) -> None:
        """Release the link."""
