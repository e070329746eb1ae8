"""One control cycle of a joint service, without any I/O.

The same code runs live, in lockstep under virtual time, and when a log is re-executed.
"""

from __future__ import annotations

from typing import Final

import msgspec

from services.joint import pd_law
from services.joint.differential import (
    joint_torque,
    limit_differential,
    limit_torque,
    limits_of,
    motor_torque,
)
from services.joint.drivers.base import DriveReading
from services.joint.envelope import NOTHING_YET, Envelope, Lately
from services.joint.failsafe import Event, Failsafe, timing_of
from services.joint.heat import HeatEstimate, HeatState
from services.joint.joint_estimate import JointEstimate, SampleClock
from services.joint.neighbours import SILENT_NS, UNKNOWN, NeighbourRow, NeighbourView
from services.joint.pd_law import Setpoint
from services.joint.setpoint_law import SetpointLaw, SetpointState
from services.joint.trips import JointTrips
from services.joint.trips import limits_of as trip_limits_of
from shared.bus.messages import Cause, JointCommand, JointEvent, JointState, Mode, Outside, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.rounding import FORCE, rounded

# Compared in each cycle: docs/contributing.md, The control path.
_DISARMED, _TRACK, _FAULT = Mode.DISARMED, Mode.TRACK, Mode.FAULT
_NONE: Final = Event.NONE


class CycleResult(msgspec.Struct, gc=False, frozen=True):
    """Outcome of one cycle."""

    tau: Pair
    """Joint torque for the drive, N m, after the limiter."""
    event: JointEvent | None
    """Change of mode in this cycle, or None."""


class ControllerState(msgspec.Struct, kw_only=True):
    """State of `JointController` that changes from cycle to cycle."""

    estimate: JointEstimate
    failsafe: Failsafe = msgspec.field(default_factory=Failsafe)
    trips: JointTrips = msgspec.field(default_factory=JointTrips)
    initial_torque: Pair | None = None
    """Torque of a drive that was found armed, N m; the take-over starts from it."""
    takeover_offset: Pair = (0.0, 0.0)
    """Drive's torque minus the law's when the service resumed after a gap, N m."""
    lately: Lately = NOTHING_YET
    """Accumulated drift and energy of the accepted commands."""
    resumed_ns: int = 0
    last_cycle_ns: int = 0
    cause: int = 0
    """`Cause` of the last change of mode."""
    tau: Pair = (0.0, 0.0)
    """Joint torque of the last cycle (phi, theta), N m."""
    cycle: int = 0
    late: int = 0
    """Number of cycles that started more than two periods after the previous one."""
    clock: SampleClock = msgspec.field(default_factory=SampleClock)
    events: int = 0
    states: int = 0
    law: SetpointState
    heat: HeatState


class JointController:
    """Control law of one module; everything that changes between cycles is in `ControllerState`.

    Attributes:
        timing: times and limits of the failsafe.
        heat: estimate of the motors' temperatures.
    """

    def __init__(self, config: RobotConfig, module: str) -> None:
        service = config.joint_service
        self.timing = timing_of(config)
        self._envelope = Envelope(config, module)
        self._limits = limits_of(config, module)
        self._trip_limits = trip_limits_of(config)
        self._gear_ratio = config.joint.gear_ratio
        self._blend_ns = service.blend_ms * NS_PER_MS
        self._period_late_ns = round(2 * NS_PER_S / service.rate_hz)
        self._period_ns = round(NS_PER_S / service.rate_hz)
        self._state_every = round(service.rate_hz / service.state_rate_hz)
        self._law = SetpointLaw(config, module)
        self.heat = HeatEstimate(config)

    def start(self) -> ControllerState:
        """Return the state of a module that has just started: DISARMED."""
        return ControllerState(
            estimate=JointEstimate(self._gear_ratio),
            law=self._law.at_rest(),
            heat=self.heat.cold(),
        )

    def step(
        self,
        s: ControllerState,
        now_ns: int,
        reading: DriveReading | None,
        command: JointCommand | None,
        estop: bool,
        *,
        flushing: bool = False,
        near: NeighbourView = UNKNOWN,
    ) -> CycleResult:
        """Run one cycle: estimate, age rule, mode, setpoint and limits.

        Args:
            s: the module's state, updated in place.
            now_ns: this module's monotonic clock.
            reading: the drive's newest sample, or None if it did not arrive in time.
            command: the newest command since the last cycle, or None.
            estop: True if the emergency stop is engaged.
            flushing: True while the link's buffer is emptied after the service was frozen; samples
                may jump from the joint's old position to its present one.
            near: view of the other modules on this host.
        """
        self._count(s, now_ns)
        drive = self._estimated(s, reading, flushing=flushing)
        if command is not None:
            self._offer(s, now_ns, command)
        before = s.failsafe.mode
        cause = s.failsafe.advance(now_ns, self.timing, drive, estop, self._tripped(s, now_ns))
        if cause is not None:
            s.cause = int(cause)
            self._enter(s, now_ns, before)
        tau_before = s.tau
        setpoint = self._law.evaluate(s.law, now_ns, s.failsafe, s.estimate.q, near)
        mode = s.failsafe.mode
        if mode is _DISARMED or mode is _FAULT:
            s.tau = pd_law.ZERO
        else:
            wanted = rounded(self._wanted(s, now_ns, setpoint), FORCE)
            s.tau = limit_torque(wanted, s.estimate.q, tau_before, self._limits)
        if self.heat.enabled:
            self._warm(s, now_ns, reading)
        event = None if cause is None else _event(s, now_ns, before, cause, tau_before)
        return CycleResult(s.tau, event)

    def resume(self, s: ControllerState, now_ns: int, carried: Pair) -> Pair:
        """Continue from the drive's torque after a gap in which the drive received no commands.

        The difference between this torque and the law's fades over `joint_service.blend_ms`.
        Returns the joint torque of this cycle, N m: the drive's, limited by `limit_differential`.

        Args:
            s: the module's state, updated in place.
            now_ns: this module's monotonic clock at the cycle just run.
            carried: the drive's present joint torques (phi, theta), N m.
        """
        wanted = pd_law.torque(s.law.current, s.estimate.q, s.estimate.v)
        s.takeover_offset = (carried[0] - wanted[0], carried[1] - wanted[1])
        s.resumed_ns = now_ns
        s.tau = limit_differential(carried, self._limits.tau_module_max)
        return s.tau

    def is_state_due(self, s: ControllerState) -> bool:
        """Return True if a state is due: in every nth period, at the phase the planner requests."""
        return s.clock.passed(self._state_every, self._state_phase(s))

    def _state_phase(self, s: ControllerState) -> int:
        command = s.failsafe.command
        return command.state_phase % self._state_every if command is not None else 0

    def state(self, s: ControllerState, now_ns: int) -> JointState:
        """Return the module's state message.

        Its stamp is the arrival time of the drive's sample, so a command that was computed from an
        old sample counts as old.
        """
        failsafe, estimate, command = s.failsafe, s.estimate, s.failsafe.command
        s.states += 1
        refusal, refused_session = failsafe.newest_refusal(now_ns)
        return JointState(
            t_ns=estimate.t_ns,
            seq=s.states,
            q=estimate.q,
            v=estimate.v,
            tau=s.tau,
            mode=int(failsafe.mode),
            cause=s.cause,
            ready=failsafe.ready(now_ns, self.timing),
            age_ns=failsafe.age_ns(now_ns),
            session=failsafe.session,
            command_seq=command.seq if command is not None else -1,
            cycle=s.cycle,
            late=s.late,
            dropouts=failsafe.dropouts.count,
            refused=failsafe.refused,
            drive=int(estimate.status),
            drive_error=estimate.error,
            stiffened=s.law.stiffened_ns > 0,
            outside=int(failsafe.current_outside(now_ns, self.timing)),
            state_phase=self._state_phase(s),
            refusal=int(refusal),
            refused_session=refused_session,
            celsius=s.heat.shown,
            heat_left_s=s.heat.left_s,
            supply_v=estimate.supply_v,
        )

    def inside_limits(self, s: ControllerState) -> bool:
        """Return True if the joint was last measured inside its soft stops."""
        limits, q = self._limits, s.estimate.q
        return limits.phi[0] <= q[0] <= limits.phi[1] and limits.theta[0] <= q[1] <= limits.theta[1]

    def _count(self, s: ControllerState, now_ns: int) -> None:
        s.cycle += 1
        if s.last_cycle_ns and now_ns - s.last_cycle_ns > self._period_late_ns:
            s.late += 1
        s.last_cycle_ns = now_ns
        s.clock.advance(now_ns, self._period_ns)

    def _estimated(
        self, s: ControllerState, reading: DriveReading | None, *, flushing: bool
    ) -> Event:
        """Update the joint's estimate; return the drive's event."""
        if reading is None:
            return _NONE
        armed = s.failsafe.mode is not _DISARMED and not flushing
        event = s.estimate.process(reading, armed=armed, flushing=flushing, tau=s.tau)
        if reading.torque is not None:
            s.initial_torque = joint_torque(reading.torque, self._gear_ratio)
        return event

    def _offer(self, s: ControllerState, now_ns: int, command: JointCommand) -> None:
        """Check a command against the age rule and the envelope."""
        tracked = s.failsafe.command if s.failsafe.mode is _TRACK else None
        lately = self._envelope.accumulated(command, tracked, s.lately, s.estimate.v, now_ns)
        outside = self._envelope.judge(
            command,
            tracked,
            s.estimate.q,
            s.estimate.v,
            age_s=self._law.age_s(command, now_ns),
            settled=tracked is not None and self._law.is_settled(s.law, now_ns),
            lately=lately,
        )
        s.failsafe.offer(command, now_ns, self.timing, outside)
        if s.failsafe.command is command:
            s.lately = lately

    def _tripped(self, s: ControllerState, now_ns: int) -> Event:
        """Return the trip of this cycle; only a module in TRACK trips."""
        if s.failsafe.mode is _TRACK:
            return s.trips.judge(now_ns, s.tau, s.estimate.v, self._trip_limits)
        s.trips.reset(s.tau)
        return _NONE

    def _enter(self, s: ControllerState, now_ns: int, before: Mode) -> None:
        """Start a mode from the present setpoint; after DISARMED, by standing or taking over."""
        law = self._law
        q, v = s.estimate.q, s.estimate.v
        if before is not Mode.DISARMED:
            law.change(s.law, s.failsafe.mode, now_ns, q)
            return
        k_p, k_d = law.stand_k_p, law.stand_k_d
        if s.initial_torque is None:
            law.start(s.law, s.failsafe.mode, now_ns, pd_law.stand(q, k_p, k_d))
            return
        command = s.failsafe.command
        accepted = s.failsafe.outside is Outside.NOTHING
        if command is not None and accepted and s.failsafe.is_fresh(now_ns, self.timing):
            k_p, k_d = command.k_p, command.k_d  # as soft as the other five modules
        carried = pd_law.take_over(q, v, s.initial_torque, k_p, k_d)
        law.start(s.law, s.failsafe.mode, now_ns, carried)
        s.tau = s.initial_torque  # the limiter starts from it

    def _warm(self, s: ControllerState, now_ns: int, reading: DriveReading | None) -> None:
        """Update the estimate of the motors' temperatures."""
        fet = motor = None
        if reading is not None:
            fet, motor = reading.fet_celsius, reading.motor_celsius
        self.heat.advance(s.heat, now_ns, motor_torque(s.tau, self._gear_ratio), fet, motor)

    def _wanted(self, s: ControllerState, now_ns: int, setpoint: Setpoint) -> Pair:
        """Return the law's torque plus the remaining take-over offset, N m."""
        wanted = pd_law.torque(setpoint, s.estimate.q, s.estimate.v)
        if s.takeover_offset == pd_law.ZERO:
            return wanted
        fraction = 1.0 - (now_ns - s.resumed_ns) / self._blend_ns
        if fraction <= 0.0:
            s.takeover_offset = pd_law.ZERO
            return wanted
        phi, theta = s.takeover_offset
        return (wanted[0] + fraction * phi, wanted[1] + fraction * theta)


def _event(
    s: ControllerState, now_ns: int, before: Mode, cause: Cause, tau_before: Pair
) -> JointEvent:
    s.events += 1
    return JointEvent(
        t_ns=now_ns,
        seq=s.events,
        mode_before=int(before),
        mode_after=int(s.failsafe.mode),
        cause=int(cause),
        age_ns=s.failsafe.age_ns(now_ns),
        tau_before=tau_before,
        tau_after=s.tau,
    )


def row_of(s: ControllerState, now_ns: int) -> NeighbourRow:
    """Return the row that the module's neighbours read."""
    estimate, mode = s.estimate, s.failsafe.mode
    silent = mode is not _DISARMED and now_ns - estimate.t_ns > SILENT_NS
    return NeighbourRow(
        estimate.accepted_ns,
        estimate.q[1],
        estimate.v[1],
        mode,
        int(s.law.stays),
        int(silent),
    )
