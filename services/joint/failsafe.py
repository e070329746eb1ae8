"""Modes of a joint service and the age rule (docs/architecture.md#age-rule).

Pure: state, now, inputs -> state. The transitions are one table; `tests/safety` sweeps every mode
against every event.

    DISARMED -> HOLD <-> TRACK;  each of them -> DAMP (emergency stop)
    HOLD, TRACK, DAMP -> FAULT (drive lost or disarmed, position lost), or DAMP, limp (after a fall)
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final

import msgspec

from shared.bus.messages import Cause, JointCommand, Mode, Outside, Refusal
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.robot.hold_rules import Dropouts


class Event(IntEnum):
    """Events of a cycle, the most severe first; each cycle acts on one."""

    ESTOP = 0
    DRIVE_LOST = 1
    DRIVE_DISARMED = 2
    POSITION_LOST = 3
    FALLEN = 4
    SHAKING = 5
    TORQUE_LIMIT = 6
    TOO_FAST = 7
    DRIVE_ARMED = 8
    PLANNER_ENDED = 9
    COMMAND_STALE = 10
    HOLD_REQUESTED = 11
    READY = 12
    NONE = 13


Q_REF_MAX: Final = 6.4
"""Largest accepted reference, rad: a little over one turn, farther than any joint moves."""
TAU_RATE_MAX: Final = 1e3
"""Largest accepted rate of the feedforward torque, N m/s per N m of `Timing.tau_max`."""
TRIPS: Final = (Event.SHAKING, Event.TORQUE_LIMIT, Event.TOO_FAST)
"""Trips that a module detects while it tracks (`services.joint.trips`)."""


TRANSITIONS: Final[dict[Mode, dict[Event, tuple[Mode, Cause]]]] = {
    Mode.DISARMED: {
        Event.ESTOP: (Mode.DAMP, Cause.ESTOP),
        Event.DRIVE_ARMED: (Mode.HOLD, Cause.DRIVE_ARMED),
    },
    Mode.HOLD: {
        Event.ESTOP: (Mode.DAMP, Cause.ESTOP),
        Event.DRIVE_LOST: (Mode.FAULT, Cause.DRIVE_LOST),
        Event.DRIVE_DISARMED: (Mode.FAULT, Cause.DRIVE_DISARMED),
        Event.POSITION_LOST: (Mode.FAULT, Cause.POSITION_LOST),
        Event.FALLEN: (Mode.DAMP, Cause.FALLEN),
        Event.READY: (Mode.TRACK, Cause.COMMANDS_FRESH),
    },
    Mode.TRACK: {
        Event.ESTOP: (Mode.DAMP, Cause.ESTOP),
        Event.DRIVE_LOST: (Mode.FAULT, Cause.DRIVE_LOST),
        Event.DRIVE_DISARMED: (Mode.FAULT, Cause.DRIVE_DISARMED),
        Event.POSITION_LOST: (Mode.FAULT, Cause.POSITION_LOST),
        Event.FALLEN: (Mode.DAMP, Cause.FALLEN),
        Event.SHAKING: (Mode.HOLD, Cause.SHAKING),
        Event.TORQUE_LIMIT: (Mode.HOLD, Cause.TORQUE_LIMIT),
        Event.TOO_FAST: (Mode.HOLD, Cause.TOO_FAST),
        Event.PLANNER_ENDED: (Mode.HOLD, Cause.PLANNER_ENDED),
        Event.COMMAND_STALE: (Mode.HOLD, Cause.COMMAND_STALE),
        Event.HOLD_REQUESTED: (Mode.HOLD, Cause.HOLD_ALL),
    },
    Mode.DAMP: {
        Event.DRIVE_LOST: (Mode.FAULT, Cause.DRIVE_LOST),
        Event.DRIVE_DISARMED: (Mode.FAULT, Cause.DRIVE_DISARMED),
        Event.POSITION_LOST: (Mode.FAULT, Cause.POSITION_LOST),
        Event.FALLEN: (Mode.DAMP, Cause.FALLEN),
    },
    Mode.FAULT: {},
}
"""(mode, event) -> (next mode, cause); an event that is not listed changes nothing. A module in
DAMP or FAULT holds again only with a new service that a person requested
(`services.joint.rearm_guard`), so a robot under load never stiffens again on its own."""


class Timing(msgspec.Struct, frozen=True):
    """Times, ns, and limits of the failsafe, SI."""

    max_command_age_ns: int
    engage_after_ns: int
    engage_after_max_ns: int
    dropout_forget_ns: int
    dropouts_max: int
    """Number of dropouts that double the wait up to its maximum; more are not counted."""
    k_p_max: float
    k_d_max: float
    v_max: float
    tau_max: float


def timing_of(config: RobotConfig) -> Timing:
    """Return the timing from the configuration."""
    service = config.joint_service
    return Timing(
        max_command_age_ns=round(service.max_command_age_ms * NS_PER_MS),
        engage_after_ns=round(service.engage_after_ms * NS_PER_MS),
        engage_after_max_ns=round(service.engage_after_max_ms * NS_PER_MS),
        dropout_forget_ns=round(service.dropout_forget_s * NS_PER_S),
        dropouts_max=math.ceil(math.log2(service.engage_after_max_ms / service.engage_after_ms)),
        k_p_max=service.k_p_max,
        k_d_max=service.k_d_max,
        v_max=service.v_max,
        tau_max=TAU_ACCEPTED_MAX * config.joint.tau_module_max,
    )


FALLEN_NS: Final = 50 * NS_PER_MS
"""Time for which a planner must report a fall, ns: one wrong command is not enough."""
RETIRED_SESSIONS_KEPT: Final = 256
"""Number of earlier sessions that stay refused; after more restarts, the oldest is forgotten."""
TAU_ACCEPTED_MAX: Final = 4.0
"""Largest accepted feedforward and coupled torque, as a multiple of a module's maximum torque: far
from its reference the law may request more than the maximum, which the limiter cuts."""
SEQ_AHEAD_MAX: Final = 500
"""Largest accepted step of `seq` beyond the ticks that `TICKS_PER_S_MAX` allows: after a far too
high one, all correct ones would be refused."""
TICKS_PER_S_MAX: Final = 2000
"""Maximum rate of a planner's ticks, 1/s, including those whose commands are lost."""
REFUSED_SHOWN_NS: Final = NS_PER_S
"""Time for which the cause of the newest refusal is reported, ns."""

# Compared in each cycle: docs/contributing.md, The control path.
_DISARMED, _HOLD, _TRACK = Mode.DISARMED, Mode.HOLD, Mode.TRACK
_ESTOP, _DRIVE_ARMED, _STALE = Event.ESTOP, Event.DRIVE_ARMED, Event.COMMAND_STALE
_PLANNER_ENDED, _FALLEN = Event.PLANNER_ENDED, Event.FALLEN
_HOLD_REQUESTED, _READY, _NONE = Event.HOLD_REQUESTED, Event.READY, Event.NONE
_INSIDE, _USABLE = Outside.NOTHING, Refusal.NONE


class Failsafe(msgspec.Struct):
    """State of one joint service's failsafe."""

    mode: Mode = Mode.DISARMED
    command: JointCommand | None = None
    """The newest accepted command."""
    session: int = 0
    """Session of the accepted commands; 0 before the first."""
    retired: tuple[int, ...] = ()
    """Earlier sessions, the last `RETIRED_SESSIONS_KEPT`; their commands are refused."""
    fresh_since_ns: int = -1
    """Start of the present unbroken time with usable commands, ns; -1 without usable commands."""
    dropouts: Dropouts = msgspec.field(default_factory=Dropouts)
    """Recent dropouts of commands; each doubles the wait before TRACK."""
    refused: int = 0
    refusal: Refusal = Refusal.NONE
    """Cause of the newest refusal."""
    refused_session: int = 0
    """Session of the newest refused command."""
    refused_ns: int = 0
    """Time of the newest refusal."""
    outside: Outside = Outside.NOTHING
    """Part of the newest usable command that is outside the envelope."""
    judged_ns: int = 0
    """Time of that judgement, which is reported only while recent."""
    planner_ended: bool = False
    """True after the end of the followed planner's process, until the cycle that acts on it."""
    fallen_since_ns: int = -1
    """Time from which the planner reports a fall, ns; -1 if it does not."""
    limp: bool = False
    """True if the robot has fallen: in DAMP, this module then only damps."""

    def offer(
        self,
        command: JointCommand,
        now_ns: int,
        timing: Timing,
        outside: Outside = Outside.NOTHING,
    ) -> Refusal:
        """Accept a command if it is usable, or count it as refused; return the reason, or NONE.

        Args:
            command: the received command.
            now_ns: this module's monotonic clock.
            timing: times and limits.
            outside: judgement of `services.joint.envelope`.
        """
        refusal = self._judge(command, now_ns, timing)
        if refusal is _USABLE or refusal is Refusal.OUT_OF_LIMITS:
            self.outside, self.judged_ns = outside, now_ns
        if refusal is _USABLE and outside is not _INSIDE and not command.hold:
            refusal = Refusal.OUT_OF_ENVELOPE
        if refusal is not _USABLE:
            self._count(refusal, command.session, 1, now_ns)
            return refusal
        if command.session != self.session:
            if self.session:
                self.retired = (*self.retired[-RETIRED_SESSIONS_KEPT + 1 :], self.session)
            self.session = command.session
            self.fresh_since_ns = -1
        self.command = command
        return refusal

    def end_session(self, session: int) -> None:
        """Record that a planner's process has ended: its newest command is no longer usable."""
        if session == self.session:
            self.fresh_since_ns = -1
            self.planner_ended = True

    def count_malformed(self, count: int, now_ns: int) -> None:
        """Count received commands that could not be decoded."""
        self._count(Refusal.MALFORMED, 0, count, now_ns)

    def _count(self, refusal: Refusal, session: int, count: int, now_ns: int) -> None:
        self.refused += count
        self.refusal, self.refused_session, self.refused_ns = refusal, session, now_ns

    @property
    def stiffen_requested(self) -> bool:
        """True in HOLD if the newest accepted command says that another module may be limp."""
        return self.mode is _HOLD and self.command is not None and self.command.stiffen

    def age_ns(self, now_ns: int) -> int:
        """Return the age of the newest accepted command on this module's clock; -1 if none."""
        return now_ns - self.command.echo_t_ns if self.command is not None else -1

    def current_outside(self, now_ns: int, timing: Timing) -> Outside:
        """Return the part of the newest command outside the envelope; NOTHING if it is old."""
        old = now_ns - self.judged_ns > timing.max_command_age_ns
        return _INSIDE if old else self.outside

    def newest_refusal(self, now_ns: int) -> tuple[Refusal, int]:
        """Return the cause of the newest refusal and its session; NONE and 0 if it is old."""
        if not self.refused or now_ns - self.refused_ns > REFUSED_SHOWN_NS:
            return _USABLE, 0
        return self.refusal, self.refused_session

    def is_fresh(self, now_ns: int, timing: Timing) -> bool:
        """Return True if the newest accepted command is within the age limit."""
        return (
            self.command is not None
            and now_ns - self.command.echo_t_ns <= timing.max_command_age_ns
        )

    def engage_after_ns(self, timing: Timing) -> int:
        """Return how long commands must be fresh before TRACK, ns; each dropout doubles it."""
        return min(timing.engage_after_ns << self.dropouts.count, timing.engage_after_max_ns)

    def ready(self, now_ns: int, timing: Timing) -> bool:
        """Return True if this module can track and has accepted commands for long enough."""
        return (
            (self.mode is _TRACK or self.mode is _HOLD)
            and self.outside is _INSIDE
            and self.fresh_since_ns >= 0
            and now_ns - self.fresh_since_ns >= self.engage_after_ns(timing)
        )

    def advance(
        self,
        now_ns: int,
        timing: Timing,
        drive: Event,
        estop: bool,
        trip: Event = _NONE,
    ) -> Cause | None:
        """Advance by one cycle; return the cause if the mode changed.

        Args:
            now_ns: this module's clock.
            timing: times and limits.
            drive: DRIVE_LOST, DRIVE_DISARMED, POSITION_LOST, DRIVE_ARMED or NONE.
            estop: True if the emergency stop is engaged.
            trip: one of `TRIPS`, or NONE.
        """
        mode, fresh = self.mode, self.is_fresh(now_ns, timing)
        tracks = mode is _TRACK
        # the planner's process has ended, or a new session has replaced a stale one in this cycle
        broken = tracks and self.fresh_since_ns < 0
        if not fresh or mode is _DISARMED:
            self.fresh_since_ns = -1  # commands from before arming do not count
        elif self.fresh_since_ns < 0:
            self.fresh_since_ns = now_ns
        if not fresh or self.command is None or not self.command.fallen or mode is _DISARMED:
            self.fallen_since_ns = -1
        elif self.fallen_since_ns < 0:
            self.fallen_since_ns = now_ns
        event = self._event(now_ns, timing, drive, estop, fresh and not broken)
        self.planner_ended = False
        if trip is not _NONE and tracks:
            gone = estop or not (drive is _NONE or drive is _DRIVE_ARMED)
            if not gone and event is not _FALLEN:
                event = trip
                self.fresh_since_ns = now_ns  # after a trip the module waits as after a dropout
        row = TRANSITIONS[mode].get(event)
        self.dropouts.advance(
            now_ns,
            engaged=tracks,
            dropped=event is _STALE or event is _PLANNER_ENDED or event in TRIPS,
            count_max=timing.dropouts_max,
            forget_ns=timing.dropout_forget_ns,
        )
        if row is None:
            return None
        self.mode = row[0]
        self.limp |= event is _FALLEN
        return row[1]

    def _event(self, now_ns: int, timing: Timing, drive: Event, estop: bool, fresh: bool) -> Event:
        if estop and self.mode not in (Mode.DAMP, Mode.FAULT):
            return _ESTOP
        if drive is _DRIVE_ARMED:
            if self.mode is _DISARMED:
                return drive
        elif drive is not _NONE:
            return drive
        said_ns = now_ns - self.fallen_since_ns if self.fallen_since_ns >= 0 else 0
        if said_ns >= FALLEN_NS and not self.limp:
            return _FALLEN
        if not fresh:
            return _PLANNER_ENDED if self.planner_ended else _STALE
        if self.command is not None and self.command.hold:
            return _HOLD_REQUESTED
        return _READY if self.ready(now_ns, timing) else _NONE

    def _judge(self, command: JointCommand, now_ns: int, timing: Timing) -> Refusal:
        age = now_ns - command.echo_t_ns
        if age < 0:
            return Refusal.FROM_THE_FUTURE
        # another session takes over only once the present one has no usable command
        foreign = command.session != self.session
        if foreign and (command.session in self.retired or self.is_fresh(now_ns, timing)):
            return Refusal.FOREIGN_SESSION
        if age > timing.max_command_age_ns:
            return Refusal.TOO_OLD
        if not foreign and self.command is not None:
            ahead = command.seq - self.command.seq
            if ahead <= 0:
                return Refusal.NOT_NEWER
            counted = TICKS_PER_S_MAX * (now_ns - self.command.echo_t_ns) / NS_PER_S
            if ahead > SEQ_AHEAD_MAX + counted:
                return Refusal.TOO_FAR_AHEAD
        return _USABLE if _within_limits(command, timing) else Refusal.OUT_OF_LIMITS


def _within_limits(command: JointCommand, timing: Timing) -> bool:
    """Return True if every number is finite and inside the service's limits.

    Written so that a NaN fails: every comparison with it is false.
    """
    for axis in (0, 1):
        if not (
            0.0 <= command.k_p[axis] <= timing.k_p_max
            and 0.0 <= command.k_d[axis] <= timing.k_d_max
            and abs(command.v_ref[axis]) <= timing.v_max
            and abs(command.q_ref[axis]) <= Q_REF_MAX
            and abs(command.tau_ff[axis]) <= timing.tau_max
            and abs(command.tau_coupled[axis]) <= timing.tau_max
            and abs(command.dtau_ff[axis]) <= TAU_RATE_MAX * timing.tau_max
        ):
            return False
    return True
