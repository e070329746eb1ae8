"""The joint's position and speed from a drive's samples, and which samples are accepted. Pure.

A drive without a valid position still reports numbers. Firmware 0.5.6 repeats the last value of a
lost encoder until a heartbeat shows the error. When the encoder is back, the count may be wrong by
whole turns. A restarted drive reports 0: when this was accepted for 40 ms, a knee was commanded
-107 N m. So a sample that the joint cannot have reached is rejected. After `REJECTED_MAX` rejected
samples in a row, the position counts as lost. It also counts as lost when whole turns may be
missing (`turn_watch`), even while the module is not controlled.

A delayed service reads two samples as one, or two within half a millisecond. If it counted cycles,
it would then send its states one cycle earlier or later than the other modules
(`services.planner.state_phases`). So `SampleClock` counts elapsed periods.
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
from shared.rounding import POSITION, RATE, rounded

JUMP_TURNS: Final = 0.1
"""Largest jump of a motor beyond the motion at its last velocity, turns: 0.02 rad at the joint."""
JUMP_SPEED: Final = 10.0
"""Largest gain of a motor's speed since the last sample, turn/s. That sample may be 100 ms old; a
leg in free fall gains 8 in that time."""
SPEED_MAX: Final = 300.0
"""Largest speed, turn/s: 100 rad/s at a joint behind 18:1, as in
`services.planner.watch.plausible`. A speed of 1e30 would also excuse any later jump."""
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
    """Number of samples rejected since then."""
    first: TurnWatch = msgspec.field(default_factory=TurnWatch)
    second: TurnWatch = msgspec.field(default_factory=TurnWatch)
    supply_v: float = 0.0
    """Voltage of the drive's supply, V; 0 if unknown."""

    @property
    def turns_lost(self) -> bool:
        """True if turns may be missing from the drive's count, until its zero is cleared."""
        return self.first.lost or self.second.lost

    @property
    def moved(self) -> bool:
        """True while the cause of a jump of the idle drive's position is still unknown."""
        known = self.first.encoder_zero != UNKNOWN and self.second.encoder_zero != UNKNOWN
        return known and (self.first.moved or self.second.moved)

    def process(
        self,
        reading: DriveReading,
        *,
        armed: bool,
        flushing: bool = False,
        tau: Pair = (0.0, 0.0),
    ) -> Event:
        """Process a sample; return its event for the failsafe.

        Args:
            reading: the drive's sample.
            armed: True if the module is controlled; otherwise any position is accepted.
            flushing: True if samples may be old and jump; no jump is then rejected.
            tau: joint torque (phi, theta) of the last cycle, N m.
        """
        self.status, self.error, self.t_ns = reading.status, reading.error, reading.t_ns
        self.supply_v = reading.supply_v
        event = _EVENT[reading.status]
        if event is _DRIVE_LOST:
            return event  # its positions are old
        if event is _POSITION_LOST:  # positions mean nothing until a new zero
            self.first, self.second = TurnWatch(lost=armed), TurnWatch(lost=armed)
            self.accepted_ns = 0
            return event
        first, second = self.first, self.second
        if reading.encoder_zero is not None:
            first.compare(reading.encoder_zero[0])
            second.compare(reading.encoder_zero[1])
        if reading.error & _ENCODER_FAILED:  # once it is back, turns may be missing
            first.lost = second.lost = True
        possible = flushing or not self.accepted_ns or self._is_plausible(reading, tau, armed=armed)
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
        self.q = rounded(joint_from_motor(reading.pos_turns, self.gear_ratio), POSITION)
        self.v = rounded(joint_from_motor(reading.vel_turns, self.gear_ratio), RATE)
        return event

    def _is_plausible(self, reading: DriveReading, tau: Pair, *, armed: bool) -> bool:
        """Return True if the motors can have moved here since the last accepted sample."""
        (a, b), (speed_a, speed_b) = reading.pos_turns, reading.vel_turns
        if not (abs(speed_a) <= SPEED_MAX and abs(speed_b) <= SPEED_MAX):
            return False
        t_ns, first, second = reading.t_ns, self.first, self.second
        dt_s = (t_ns - self.accepted_ns) / NS_PER_S
        (was_a, was_b), (vel_a, vel_b) = self.pos, self.vel
        free = JUMP_TURNS + JUMP_SPEED * dt_s
        jump_a, jump_b = a - was_a, b - was_b
        phi, theta = tau
        on_first, on_second = (theta + phi, theta - phi) if armed else (None, None)
        free_a, free_b = free + abs(vel_a) * dt_s, free + abs(vel_b) * dt_s
        first_can = first.process(t_ns, a, speed_a, jump_a, free_a, on_first)
        second_can = second.process(t_ns, b, speed_b, jump_b, free_b, on_second)
        first.moved = not armed and (first.moved or not first_can)
        second.moved = not armed and (second.moved or not second_can)
        return first_can and second_can


FOLLOW_SHIFT = 3
"""The clock moves an eighth of the way to a sample's time, so a late one counts as one period."""


class SampleClock(msgspec.Struct):
    """Periods since the first sample.

    Attributes:
        count: number of periods; 0 before the first.
        before: count at the previous sample.
    """

    count: int = 0
    before: int = 0
    at_ns: int = 0
    """Smoothed start of the present period."""

    def advance(self, now_ns: int, period_ns: int) -> None:
        """Update the count with the time of a cycle and the drive's period."""
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
        """Return True if a period phase, phase + every, ... began since the previous sample.

        If the sample of such a period is lost, the next sample returns True.
        """
        return (self.count - phase) // every > (self.before - phase) // every
