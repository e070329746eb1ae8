"""One control cycle of a joint service, without any I/O.

The same object runs live behind a drive and a bus, in lockstep under virtual time, and in
re-execution from a log.
"""

from __future__ import annotations

from typing import Final

import msgspec

from services.joint import pd_law
from services.joint.differential import joint_torque, motor_torque
from services.joint.drivers.base import DriveReading
from services.joint.envelope import NOTHING_YET, Envelope, Lately
from services.joint.failsafe import Event, Failsafe, timing_of
from services.joint.heat import HeatEstimate, HeatState
from services.joint.joint_estimate import JointEstimate
from services.joint.neighbours import SILENT_NS, UNKNOWN, NeighbourRow, NeighbourView
from services.joint.pd_law import Setpoint
from services.joint.sample_clock import SampleClock
from services.joint.setpoint_law import SetpointLaw, SetpointState
from services.joint.torque_limiter import limit_differential, limit_torque, limits_of
from services.joint.trips import JointTrips
from services.joint.trips import limits_of as trip_limits_of
from shared.bus.messages import Cause, JointCommand, JointEvent, JointState, Mode, Outside, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.state import copied

# Compared in each cycle: docs/contributing.md, The control path.
_DISARMED, _TRACK, _FAULT = Mode.DISARMED, Mode.TRACK, Mode.FAULT
_NONE: Final = Event.NONE


class CycleResult(msgspec.Struct, gc=False, frozen=True):
    """Outcome of one cycle."""

    tau: Pair
    """Joint torque for the drive, N m, after the limiter."""
    event: JointEvent | None
    """The change of mode in this cycle, if there was one."""


class ControllerState(msgspec.Struct, kw_only=True):
    """What changes from cycle to cycle in `JointController`."""

    estimate: JointEstimate
    failsafe: Failsafe = msgspec.field(default_factory=Failsafe)
    trips: JointTrips = msgspec.field(default_factory=JointTrips)
    initial_torque: Pair | None = None
    """Torque of a drive that was found armed, N m: it is taken over without a step."""
    takeover_offset: Pair = (0.0, 0.0)
    """Torque of the drive beyond the law's when the service resumed after a gap, N m."""
    lately: Lately = NOTHING_YET
    """What the commands that were obeyed have done, up to the newest."""
    resumed_ns: int = 0
    last_cycle_ns: int = 0
    cause: int = 0
    """`Cause` of the last change of mode."""
    tau: Pair = (0.0, 0.0)
    """Joint torque of the last cycle (phi, theta), N m."""
    cycle: int = 0
    late: int = 0
    """Cycles that came later than twice the period after the one before."""
    clock: SampleClock = msgspec.field(default_factory=SampleClock)
    events: int = 0
    states: int = 0
    heat: HeatState = msgspec.field(default_factory=HeatState)


class ControllerSnapshot(msgspec.Struct, kw_only=True):
    """State of `JointController`, with its setpoint law's."""

    state: ControllerState
    law: SetpointState


class JointController:
    """The control law of one module.

    Attributes:
        heat: how warm its motors are.

    All that changes from cycle to cycle is one struct (`ControllerState`) and the setpoint law's.
    """

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Take the module's limits and gains; start DISARMED."""
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
        self._state = ControllerState(
            estimate=JointEstimate(config.joint.gear_ratio), heat=self.heat.state
        )

    def step(
        self,
        now_ns: int,
        reading: DriveReading | None,
        command: JointCommand | None,
        estop: bool,
        *,
        flushing: bool = False,
        near: NeighbourView = UNKNOWN,
    ) -> CycleResult:
        """Run one cycle: estimate, age rule, mode, setpoint, limits.

        Args:
            now_ns: this module's monotonic clock.
            reading: the drive's newest sample; None if none came in time.
            command: the newest command, if one came since the last cycle.
            estop: the emergency stop is engaged.
            flushing: the service was frozen and the link's buffer is read out first: samples may
                jump from the joint's old position to its present one.
            near: what is known of the other modules on this host.
        """
        s = self._state
        self._count(now_ns)
        drive = self._estimated(reading, flushing=flushing)
        if command is not None:
            self._offer(now_ns, command)
        before = s.failsafe.mode
        cause = s.failsafe.advance(now_ns, self.timing, drive, estop, self._tripped(now_ns))
        if cause is not None:
            s.cause = int(cause)
            self._enter(now_ns, before)
        tau_before = s.tau
        setpoint = self._law.evaluate(now_ns, s.failsafe, s.estimate.q, near)
        mode = s.failsafe.mode
        if mode is _DISARMED or mode is _FAULT:
            s.tau = pd_law.ZERO
        else:
            wanted = self._wanted(now_ns, setpoint)
            s.tau = limit_torque(wanted, s.estimate.q, tau_before, self._limits)
        if self.heat.enabled:
            self._warm(now_ns, reading)
        event = None if cause is None else self._event(now_ns, before, cause, tau_before)
        return CycleResult(s.tau, event)

    def resume(self, now_ns: int, carried: Pair) -> Pair:
        """Continue from the torque that the drive carries, after a gap without commands to it.

        The difference to the law's torque fades over `joint_service.blend_ms`. Returns the joint
        torque of this cycle, N m: the carried one, within the differential's limit.

        Args:
            now_ns: this module's monotonic clock, of the cycle just run.
            carried: joint torques (phi, theta) of the drive now, N m.
        """
        s = self._state
        wanted = pd_law.torque(self._law.state.current, s.estimate.q, s.estimate.v)
        s.takeover_offset = (carried[0] - wanted[0], carried[1] - wanted[1])
        s.resumed_ns = now_ns
        s.tau = limit_differential(carried, self._limits.tau_module_max)
        return s.tau

    @property
    def failsafe(self) -> Failsafe:
        """Mode, newest command and drop-outs."""
        return self._state.failsafe

    @property
    def tau(self) -> Pair:
        """Joint torque of the last cycle (phi, theta), N m."""
        return self._state.tau

    @tau.setter
    def tau(self, tau: Pair) -> None:
        self._state.tau = tau

    @property
    def cycle(self) -> int:
        """Cycles since the start."""
        return self._state.cycle

    @cycle.setter
    def cycle(self, cycle: int) -> None:
        self._state.cycle = cycle

    @property
    def samples(self) -> JointEstimate:
        """The joint's estimate from the drive's samples."""
        return self._state.estimate

    @property
    def caught(self) -> bool:
        """True in DAMP for a module that no longer sinks: caught, or stiffened for a limp one."""
        sinking = self._law.state.sinking
        return sinking.caught or sinking.held is not None

    @property
    def cause(self) -> Cause:
        """Cause of the last change of mode."""
        return Cause(self._state.cause)

    @property
    def setpoint(self) -> Setpoint:
        """Setpoint of the last cycle."""
        return self._law.state.current

    @property
    def states(self) -> int:
        """State messages made so far."""
        return self._state.states

    @property
    def is_state_due(self) -> bool:
        """True if this cycle sends a state: every nth does, in the planner's phase."""
        return self._state.clock.passed(self._state_every, self._state_phase)

    @property
    def _state_phase(self) -> int:
        command = self._state.failsafe.command
        return command.state_phase % self._state_every if command is not None else 0

    def state(self, now_ns: int) -> JointState:
        """Return the module's state message.

        Its stamp is the arrival of the drive's sample: a command made from an old sample is old.
        """
        s = self._state
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
            stiffened=self._law.stiffened,
            outside=int(failsafe.current_outside(now_ns, self.timing)),
            state_phase=self._state_phase,
            refusal=int(refusal),
            refused_session=refused_session,
            celsius=s.heat.shown,
            heat_left_s=s.heat.left_s,
            supply_v=estimate.supply_v,
        )

    def snapshot(self) -> ControllerSnapshot:
        """Return a copy of the state; `restore` continues from it."""
        return ControllerSnapshot(state=copied(self._state), law=copied(self._law.state))

    def restore(self, snapshot: ControllerSnapshot) -> None:
        """Continue from a copy of a state."""
        self._state = copied(snapshot.state)
        self.heat.state = self._state.heat
        self._law.restore(copied(snapshot.law))

    def inside_limits(self) -> bool:
        """Return True if the joint was last measured inside its soft stops."""
        limits, q = self._limits, self._state.estimate.q
        return limits.phi[0] <= q[0] <= limits.phi[1] and limits.theta[0] <= q[1] <= limits.theta[1]

    def _count(self, now_ns: int) -> None:
        s = self._state
        s.cycle += 1
        if s.last_cycle_ns and now_ns - s.last_cycle_ns > self._period_late_ns:
            s.late += 1
        s.last_cycle_ns = now_ns
        s.clock.advance(now_ns, self._period_ns)

    def _estimated(self, reading: DriveReading | None, *, flushing: bool) -> Event:
        """Update the joint's estimate; return what happened to the drive."""
        s = self._state
        if reading is None:
            return _NONE
        armed = s.failsafe.mode is not _DISARMED and not flushing
        event = s.estimate.take(reading, armed=armed, flushing=flushing)
        if reading.torque is not None:
            s.initial_torque = joint_torque(reading.torque, self._gear_ratio)
        return event

    def count_malformed(self, count: int, now_ns: int) -> None:
        """Count what came as a command and was none, before the cycle in which it came."""
        self._state.failsafe.count_malformed(count, now_ns)

    def end_session(self, session: int) -> None:
        """Take a planner's process for ended, before the cycle in which that was seen."""
        self._state.failsafe.end_session(session)

    def _offer(self, now_ns: int, command: JointCommand) -> None:
        """Let the age rule and the envelope decide about a command."""
        s = self._state
        tracked = s.failsafe.command if s.failsafe.mode is _TRACK else None
        lately = self._envelope.lately(command, tracked, s.lately, s.estimate.v, now_ns)
        outside = self._envelope.judge(
            command,
            tracked,
            s.estimate.q,
            s.estimate.v,
            age_s=self._law.age_s(command, now_ns),
            settled=tracked is not None and self._law.is_settled(now_ns),
            lately=lately,
        )
        s.failsafe.offer(command, now_ns, self.timing, outside)
        if s.failsafe.command is command:
            s.lately = lately

    def _tripped(self, now_ns: int) -> Event:
        """Return the trip of this cycle; only a module in TRACK trips."""
        s = self._state
        if s.failsafe.mode is _TRACK:
            return s.trips.judge(now_ns, s.tau, s.estimate.v, self._trip_limits)
        s.trips.rest(s.tau)
        return _NONE

    def _enter(self, now_ns: int, before: Mode) -> None:
        """Start a mode from the present setpoint, or from the torque of an armed drive."""
        s, law = self._state, self._law
        q, v = s.estimate.q, s.estimate.v
        if before is not Mode.DISARMED:
            law.change(s.failsafe.mode, now_ns, q)
            return
        k_p, k_d = law.stand_k_p, law.stand_k_d
        if s.initial_torque is None:
            law.start(s.failsafe.mode, now_ns, pd_law.stand(q, k_p, k_d))
            return
        command = s.failsafe.command
        accepted = s.failsafe.outside is Outside.NOTHING
        if command is not None and accepted and s.failsafe.is_fresh(now_ns, self.timing):
            k_p, k_d = command.k_p, command.k_d  # as soft as the other five
        carried = pd_law.take_over(q, v, s.initial_torque, k_p, k_d)
        law.start(s.failsafe.mode, now_ns, carried)
        s.tau = s.initial_torque  # the limiter takes it for the last torque

    def _warm(self, now_ns: int, reading: DriveReading | None) -> None:
        """Update the estimate of the module's heat."""
        fet = motor = None
        if reading is not None:
            fet, motor = reading.fet_celsius, reading.motor_celsius
        self.heat.advance(now_ns, motor_torque(self._state.tau, self._gear_ratio), fet, motor)

    def _wanted(self, now_ns: int, setpoint: Setpoint) -> Pair:
        """Return the law's torque, N m, with the rest of a take-over's difference."""
        s = self._state
        wanted = pd_law.torque(setpoint, s.estimate.q, s.estimate.v)
        if s.takeover_offset == pd_law.ZERO:
            return wanted
        fraction = 1.0 - (now_ns - s.resumed_ns) / self._blend_ns
        if fraction <= 0.0:
            s.takeover_offset = pd_law.ZERO
            return wanted
        phi, theta = s.takeover_offset
        return (wanted[0] + fraction * phi, wanted[1] + fraction * theta)

    def _event(self, now_ns: int, before: Mode, cause: Cause, tau_before: Pair) -> JointEvent:
        s = self._state
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


def row_of(controller: JointController, now_ns: int) -> NeighbourRow:
    """Return the row that the module's neighbours read."""
    estimate, mode = controller.samples, controller.failsafe.mode
    silent = mode is not _DISARMED and now_ns - estimate.t_ns > SILENT_NS
    return NeighbourRow(
        estimate.accepted_ns,
        estimate.q[1],
        estimate.v[1],
        mode,
        int(controller.caught),
        int(silent),
    )
