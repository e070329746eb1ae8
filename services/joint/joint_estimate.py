"""The joint's position and speed from a drive's samples, and which samples are accepted. Pure.

A drive without a valid position goes on reporting numbers. Firmware 0.5.6 repeats the last value of
a lost encoder until a heartbeat shows the error, and starts over, turns away, when it is back; a
restarted drive reports 0. Accepted for 40 ms, a knee at 0 was commanded -107 N m. So a sample that
the joint cannot have reached is rejected, and after a few of them the position counts as lost. So
it does when whole turns may be missing (`turn_watch`), also while the module is not controlled.

A service that is held up reads two samples as one, or two within half a millisecond. By counting
its cycles, it would from then on send its states a cycle apart from the other modules
(`services.planner.state_phases`). So `SampleClock` counts the periods that have gone by.
"""

from __future__ import annotations

from typing import Final

import msgspec

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import DriveReading
from services.joint.failsafe import Event
from services.joint.turn_watch import UNKNOWN, TurnWatch
from shared.bus.messages import DriveStatus, Pair
from shared.can.cansimple import AxisError
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
_ENCODER_FAILED: Final = int(AxisError.ENCODER_FAILED)
_EVENT: Final = {
    DriveStatus.LOST: Event.DRIVE_LOST,
    DriveStatus.IDLE: Event.DRIVE_DISARMED,
    DriveStatus.ARMED: Event.DRIVE_ARMED,
    DriveStatus.ERROR: Event.DRIVE_DISARMED,
    DriveStatus.UNZEROED: Event.POSITION_LOST,
    DriveStatus.HOLDING: Event.NONE,
    DriveStatus.UNACKNOWLEDGED: Event.DRIVE_LOST,
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
    first: TurnWatch = msgspec.field(default_factory=TurnWatch)
    second: TurnWatch = msgspec.field(default_factory=TurnWatch)
    supply_v: float = 0.0
    """Voltage of the drive's supply, V; 0: not known."""

    @property
    def turns_lost(self) -> bool:
        """True if the drive's count may lack turns, until it has no zero any more."""
        return self.first.lost or self.second.lost

    @property
    def moved(self) -> bool:
        """True if the drive has not yet shown why its position jumped while it was idle."""
        known = self.first.encoder_zero != UNKNOWN and self.second.encoder_zero != UNKNOWN
        return known and (self.first.moved or self.second.moved)

    def take(self, reading: DriveReading, *, armed: bool, flushing: bool = False) -> Event:
        """Take a sample; return its event for the failsafe.

        Args:
            reading: the drive's sample.
            armed: True if the module is controlled; otherwise any position is accepted.
            flushing: samples may be old, and jump: nothing is judged.
        """
        self.status, self.error, self.t_ns = reading.status, reading.error, reading.t_ns
        self.supply_v = reading.supply_v
        event = _EVENT[reading.status]
        if event is _DRIVE_LOST:
            return event  # with positions that are old
        if event is _POSITION_LOST:  # they mean nothing, and the next zero is a new one
            self.first, self.second = TurnWatch(lost=armed), TurnWatch(lost=armed)
            self.accepted_ns = 0
            return event
        first, second = self.first, self.second
        if reading.encoder_zero is not None:
            first.compare(reading.encoder_zero[0])
            second.compare(reading.encoder_zero[1])
        if reading.error & _ENCODER_FAILED:  # when it is back, turns may be missing
            first.lost = second.lost = True
        possible = flushing or not self.accepted_ns or self._is_plausible(reading, armed=armed)
        if armed and not possible:
            self.rejected_count += 1
            if self.rejected_count >= REJECTED_MAX:
                first.lost = second.lost = True
            elif event is _DRIVE_ARMED:
                return _NONE
        if (first.lost or second.lost) and event is _DRIVE_ARMED:
            return _POSITION_LOST
        if armed and not possible:
            return event
        self.rejected_count = 0
        self.pos, self.vel, self.accepted_ns = reading.pos_turns, reading.vel_turns, self.t_ns
        self.q = joint_from_motor(reading.pos_turns, self.gear_ratio)
        self.v = joint_from_motor(reading.vel_turns, self.gear_ratio)
        return event

    def _is_plausible(self, reading: DriveReading, *, armed: bool) -> bool:
        """Return True if the motors can have come here since the last accepted sample."""
        (a, b), (speed_a, speed_b) = reading.pos_turns, reading.vel_turns
        if not (abs(speed_a) <= SPEED_MAX and abs(speed_b) <= SPEED_MAX):
            return False
        t_ns, first, second = reading.t_ns, self.first, self.second
        dt_s = (t_ns - self.accepted_ns) / NS_PER_S
        (was_a, was_b), (vel_a, vel_b) = self.pos, self.vel
        free = JUMP_TURNS + JUMP_SPEED * dt_s
        jump_a, jump_b = a - was_a, b - was_b
        first_can = first.take(t_ns, a, speed_a, jump_a, free + abs(vel_a) * dt_s)
        second_can = second.take(t_ns, b, speed_b, jump_b, free + abs(vel_b) * dt_s)
        first.moved = not armed and (first.moved or not first_can)
        second.moved = not armed and (second.moved or not second_can)
        return first_can and second_can


FOLLOW_SHIFT = 3
"""The clock follows a sample's time by an eighth: a single late sample counts as one."""


class SampleClock(msgspec.Struct):
    """Periods since the first sample.

    Attributes:
        count: of periods; 0 before the first.
        before: the count at the sample before.
    """

    count: int = 0
    before: int = 0
    at_ns: int = 0
    """When the present period began, smoothed."""

    def advance(self, now_ns: int, period_ns: int) -> None:
        """Take the time of a cycle, and the drive's period."""
        self.before = self.count
        if not self.count:
            self.count, self.at_ns = 1, now_ns
            return
        since_ns = now_ns - self.at_ns
        periods = max(0, (since_ns + period_ns // 2) // period_ns)
        self.count += periods
        self.at_ns += periods * period_ns
        self.at_ns += (now_ns - self.at_ns) >> FOLLOW_SHIFT

    def passed(self, every: int, phase: int) -> bool:
        """Return True if a period phase, phase + every, ... began since the sample before.

        With a sample lost, it is the next sample that passes it.
        """
        return (self.count - phase) // every > (self.before - phase) // every
