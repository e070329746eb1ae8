"""The joint's position and speed from a drive's samples, and which samples are accepted. Pure.

A drive without a valid position goes on reporting numbers. Firmware 0.5.6 repeats the last value of
a lost encoder until a heartbeat shows the error, and starts over, turns away, when it is back; a
restarted drive reports 0. Accepted for 40 ms, a knee at 0 was commanded -107 N m. So a sample that
the joint cannot have reached is rejected, and after a few of them the position counts as lost.
"""

from __future__ import annotations

from typing import Final

import msgspec

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import DriveReading, DriveStatus
from services.joint.failsafe import Event
from shared.bus.messages import Pair
from shared.clock import NS_PER_S

JUMP_TURNS: Final = 0.1
"""Largest jump at the motor beyond the last velocity, turns: 0.02 rad at the joint."""
JUMP_SPEED: Final = 10.0
"""turn/s that a motor may have gained since the last sample, which may be 100 ms old: a leg
in free fall gains 8."""
SPEED_MAX: Final = 300.0
"""turn/s: 100 rad/s at a joint behind 18:1, as `services.planner.watch.plausible` has it. A speed
of 1e30 would also excuse any jump after it."""
REJECTED_MAX: Final = 3
"""Number of rejected samples in a row after which the position is lost."""

# Compared in each cycle: docs/contributing.md, The control path.
_NONE, _DRIVE_ARMED = Event.NONE, Event.DRIVE_ARMED
_DRIVE_LOST, _POSITION_LOST = Event.DRIVE_LOST, Event.POSITION_LOST
_EVENT: Final = {
    DriveStatus.LOST: Event.DRIVE_LOST,
    DriveStatus.IDLE: Event.DRIVE_DISARMED,
    DriveStatus.ARMED: Event.DRIVE_ARMED,
    DriveStatus.ERROR: Event.DRIVE_DISARMED,
    DriveStatus.UNZEROED: Event.POSITION_LOST,
    DriveStatus.HOLDING: Event.NONE,
}


class JointEstimate(msgspec.Struct):
    """Newest accepted sample of a module, at the joint."""

    gear_ratio: float
    q: Pair = (0.0, 0.0)
    """Angles (phi, theta), rad."""
    v: Pair = (0.0, 0.0)
    """rad/s"""
    pos: Pair = (0.0, 0.0)
    """Motor positions, turns."""
    vel: Pair = (0.0, 0.0)
    """turn/s"""
    t_ns: int = 0
    """Time of the drive's newest sample, accepted or not; 0 before the first."""
    status: DriveStatus = DriveStatus.LOST
    error: int = 0
    """The drive's error bits."""
    accepted_ns: int = 0
    """Time of the newest accepted sample."""
    rejected_count: int = 0
    """Samples rejected since then."""

    def take(self, reading: DriveReading, *, armed: bool) -> Event:
        """Take a sample; return its event for the failsafe.

        Args:
            reading: the drive's sample.
            armed: True if the module is controlled; otherwise any position is accepted.
        """
        self.status, self.error, self.t_ns = reading.status, reading.error, reading.t_ns
        event = _EVENT[reading.status]
        if event is _DRIVE_LOST or event is _POSITION_LOST:
            return event  # with positions that are old, or mean nothing
        if armed and not self._is_plausible(reading):
            self.rejected_count += 1
            if event is not _DRIVE_ARMED:
                return event
            return _POSITION_LOST if self.rejected_count >= REJECTED_MAX else _NONE
        self.rejected_count = 0
        self.pos, self.vel, self.accepted_ns = reading.pos_turns, reading.vel_turns, self.t_ns
        self.q = joint_from_motor(reading.pos_turns, self.gear_ratio)
        self.v = joint_from_motor(reading.vel_turns, self.gear_ratio)
        return event

    def _is_plausible(self, reading: DriveReading) -> bool:
        dt_s = (reading.t_ns - self.accepted_ns) / NS_PER_S
        (a, b), (was_a, was_b), (vel_a, vel_b) = reading.pos_turns, self.pos, self.vel
        free = JUMP_TURNS + JUMP_SPEED * dt_s
        speed_a, speed_b = reading.vel_turns
        if not (abs(speed_a) <= SPEED_MAX and abs(speed_b) <= SPEED_MAX):
            return False
        return abs(a - was_a) <= free + abs(vel_a) * dt_s and (
            abs(b - was_b) <= free + abs(vel_b) * dt_s
        )
