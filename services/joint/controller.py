"""One control cycle of a joint service, without any I/O.

Read, age, failsafe, law, gate: the same object runs live behind a drive and a bus, in
lockstep under virtual time, and in re-execution from a log.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from services.joint import pd_law
from services.joint.differential import joint_torque
from services.joint.drivers.base import DriveReading
from services.joint.envelope import Envelope
from services.joint.failsafe import Event, Failsafe, timing_of
from services.joint.joint_estimate import JointEstimate
from services.joint.neighbours import UNKNOWN, NeighbourRow, NeighbourView
from services.joint.pd_law import Setpoint
from services.joint.sinking import Sinking
from services.joint.snapshots import ControllerState
from services.joint.torque_limiter import limit_differential, limit_torque, limits_of
from services.joint.trips import JointTrips
from services.joint.trips import limits_of as trip_limits_of
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import RobotConfig
from shared.messages import Cause, JointCommand, JointEvent, JointState, Mode, Outside, Pair


class CycleResult(NamedTuple):
    """What one cycle decided."""

    tau: Pair
    """Joint torque for the drive, N m, after the gate."""
    event: JointEvent | None
    """The change of state of this cycle, if there was one."""


class JointController:
    """The control law of one module and its memory."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Take the module's limits and stand gains; start DISARMED."""
        service = config.joint_service
        stand = config.stand_gains(module)
        self.failsafe = Failsafe()
        self.timing = timing_of(config)
        self._envelope = Envelope(config, module)
        self._hold_torque = config.envelope.hold_torque
        self._limits = limits_of(config, module)
        self._trips, self._trip_limits = JointTrips(), trip_limits_of(config)
        self._stand_k_p, self._stand_k_d = stand.k_p, stand.k_d
        self._support_k_p, self._support_k_d = config.support_gains(module)
        self._sinking = Sinking(config, module)
        self._hold_k_p, self._hold_k_d = config.hold_gains(module)
        self._gear_ratio = config.joint.gear_ratio
        self._aging_max_s = service.command_aging_max_ms / 1e3
        self._coupled_ramp_ns = service.coupled_ramp_ms * NS_PER_MS
        self._blend_ns = service.blend_ms * NS_PER_MS
        self._period_late_ns = round(2 * NS_PER_S / service.rate_hz)
        self._frozen_setpoint: Setpoint = pd_law.stand(
            pd_law.ZERO, self._stand_k_p, self._stand_k_d
        )
        """The setpoint at the last change of state: what HOLD holds and TRACK blends from."""
        self._setpoint: Setpoint = self._frozen_setpoint
        self._changed_ns = 0
        self._last_cycle_ns = 0
        self._samples = JointEstimate(config.joint.gear_ratio)
        self._initial_torque: Pair | None = None
        """What a drive that was found armed carries, N m: it is taken over without a step."""
        self._takeover_offset: Pair = pd_law.ZERO
        """What the drive carried beyond the law as the service went on after a gap, N m."""
        self._resumed_ns = 0
        self._stiffened_ns = 0
        """Since when it stiffens because another module may be limp; 0: it does not."""
        self._near = UNKNOWN
        self._cause = 0
        self.tau: Pair = pd_law.ZERO
        self.cycle = 0
        self.late = 0
        self._events = 0
        self._states = 0

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
        """Run one cycle.

        Args:
            now_ns: this module's monotonic clock.
            reading: the drive's newest sample; None if none came in time.
            command: the newest command, if one came since the last cycle.
            estop: the emergency stop is engaged.
            flushing: the service was frozen, and what the link's buffer kept comes first: samples
                may jump from where the joint was to where it is.
            near: what is known of the other modules on this host.
        """
        self._count(now_ns)
        self._near = near
        failsafe, samples = self.failsafe, self._samples
        drive = Event.NONE
        if reading is not None:
            controlled = failsafe.mode is not Mode.DISARMED and not flushing
            drive = samples.take(reading, armed=controlled)
            if reading.torque is not None:
                self._initial_torque = joint_torque(reading.torque, self._gear_ratio)
        if command is not None:
            tracked = failsafe.command if failsafe.mode is Mode.TRACK else None
            age_s = min(self._aging_max_s, (now_ns - command.echo_t_ns) / NS_PER_S)
            settled = tracked is not None and now_ns - self._changed_ns >= self._blend_ns
            outside = self._envelope.judge(
                command, tracked, samples.q, samples.v, age_s=age_s, settled=settled
            )
            failsafe.offer(command, now_ns, self.timing, outside)
        before, trip = failsafe.mode, Event.NONE
        if before is Mode.TRACK:
            trip = self._trips.judge(now_ns, self.tau, samples.v, self._trip_limits)
        else:
            self._trips.rest(self.tau)
        cause = failsafe.advance(now_ns, self.timing, drive, estop, trip)
        if cause is not None:
            self._cause = int(cause)
            self._enter(now_ns, before)
        limp = near.stiffen and failsafe.mode in (Mode.HOLD, Mode.DAMP)
        if not self._stiffened_ns and (limp or failsafe.asks_to_stiffen):
            self._stiffened_ns = now_ns
        self._setpoint = self._evaluate(now_ns)
        tau_before = self.tau
        if failsafe.mode in (Mode.DISARMED, Mode.FAULT):
            self.tau = pd_law.ZERO
        else:
            wanted = self._wanted(now_ns)
            self.tau = limit_torque(wanted, samples.q, tau_before, self._limits)
        event = None
        if cause is not None:
            event = self._event(now_ns, before, cause, tau_before)
        return CycleResult(self.tau, event)

    def resume(self, now_ns: int, carried: Pair) -> Pair:
        """Go on from what the drive carries, after a gap in which nobody told it anything.

        What the law asks for beyond that, or less, comes in over `joint_service.blend_ms`.
        Returns the joint torque of this cycle, N m: what is carried, within the diamond.

        Args:
            now_ns: this module's monotonic clock, of the cycle just run.
            carried: joint torques (phi, theta) that the drive gives now, N m.
        """
        s = self._samples
        wanted = pd_law.torque(self._setpoint, s.q, s.v)
        self._takeover_offset = (carried[0] - wanted[0], carried[1] - wanted[1])
        self._resumed_ns = now_ns
        self.tau = limit_differential(carried, self._limits.tau_module_max)
        return self.tau

    @property
    def samples(self) -> JointEstimate:
        """What the drive's samples say of the joint."""
        return self._samples

    @property
    def caught(self) -> bool:
        """True for a knee in DAMP that does not sink any more for the others' sake."""
        return self._sinking.caught

    @property
    def cause(self) -> Cause:
        """Why the mode was last changed."""
        return Cause(self._cause)

    @property
    def setpoint(self) -> Setpoint:
        """The local law of this cycle."""
        return self._setpoint

    def state(self, now_ns: int) -> JointState:
        """Return the module's state message.

        Its stamp is when the drive's sample came: commands made from old samples are old.
        """
        failsafe, samples = self.failsafe, self._samples
        command = failsafe.command
        self._states += 1
        return JointState(
            t_ns=samples.t_ns,
            seq=self._states,
            q=samples.q,
            v=samples.v,
            tau=self.tau,
            mode=int(failsafe.mode),
            cause=self._cause,
            ready=failsafe.ready(now_ns, self.timing),
            age_ns=failsafe.age_ns(now_ns),
            session=failsafe.session,
            command_seq=command.seq if command is not None else -1,
            cycle=self.cycle,
            late=self.late,
            dropouts=failsafe.dropouts,
            refused=failsafe.refused,
            drive=int(samples.status),
            drive_error=samples.error,
            stiffened=self._stiffened_ns > 0,
            outside=int(failsafe.disbelieves(now_ns, self.timing)),
        )

    def snapshot(self) -> ControllerState:
        """Return the state; `restore` continues from it."""
        return ControllerState(
            failsafe=self.failsafe,
            samples=self._samples,
            frozen_setpoint=self._frozen_setpoint,
            setpoint=self._setpoint,
            changed_ns=self._changed_ns,
            last_cycle_ns=self._last_cycle_ns,
            initial_torque=self._initial_torque,
            cause=self._cause,
            tau=self.tau,
            cycle=self.cycle,
            late=self.late,
            events=self._events,
            states=self._states,
            takeover_offset=self._takeover_offset,
            resumed_ns=self._resumed_ns,
            stiffened_ns=self._stiffened_ns,
            trips=msgspec.structs.replace(self._trips),
            sinking=self._sinking.snapshot(),
        )

    def restore(self, memory: ControllerState) -> None:
        """Continue from a state."""
        m = memory
        self.failsafe = msgspec.structs.replace(m.failsafe)  # copies: these go on changing
        self._samples = msgspec.structs.replace(m.samples)
        self._frozen_setpoint, self._setpoint = m.frozen_setpoint, m.setpoint
        self._changed_ns, self._last_cycle_ns = m.changed_ns, m.last_cycle_ns
        self._initial_torque, self._cause, self.tau = m.initial_torque, m.cause, m.tau
        self._sinking.restore(m.sinking)
        self.cycle, self.late, self._events, self._states = m.cycle, m.late, m.events, m.states
        self._takeover_offset, self._resumed_ns = m.takeover_offset, m.resumed_ns
        self._stiffened_ns = m.stiffened_ns
        self._trips = msgspec.structs.replace(m.trips)

    def inside_limits(self) -> bool:
        """Return True if the joint was last seen inside its soft stops."""
        limits, q = self._limits, self._samples.q
        return limits.phi[0] <= q[0] <= limits.phi[1] and limits.theta[0] <= q[1] <= limits.theta[1]

    def _wanted(self, now_ns: int) -> Pair:
        """Return the law's torque, N m, and what is left of a gap's difference."""
        wanted = pd_law.torque(self._setpoint, self._samples.q, self._samples.v)
        if self._takeover_offset == pd_law.ZERO:
            return wanted
        share = 1.0 - (now_ns - self._resumed_ns) / self._blend_ns
        if share <= 0.0:
            self._takeover_offset = pd_law.ZERO
            return wanted
        phi, theta = self._takeover_offset
        return (wanted[0] + share * phi, wanted[1] + share * theta)

    def _count(self, now_ns: int) -> None:
        self.cycle += 1
        if self._last_cycle_ns and now_ns - self._last_cycle_ns > self._period_late_ns:
            self.late += 1
        self._last_cycle_ns = now_ns

    def _enter(self, now_ns: int, before: Mode) -> None:
        """Take the anchor of the new mode: what was in force until now, frozen."""
        self._changed_ns = now_ns
        if self.failsafe.mode is not Mode.DAMP:
            self._stiffened_ns = 0
        k_p, k_d = self._stand_k_p, self._stand_k_d
        if before is Mode.DISARMED and self._initial_torque is not None:
            q, v = self._samples.q, self._samples.v
            command = self.failsafe.command
            accepted = self.failsafe.outside is Outside.NOTHING
            if command is not None and accepted and self.failsafe.usable(now_ns, self.timing):
                k_p, k_d = command.k_p, command.k_d  # as soft as the other five
            self._frozen_setpoint = pd_law.take_over(q, v, self._initial_torque, k_p, k_d)
            self.tau = self._initial_torque  # what the gate takes for the last torque
        elif before is Mode.DISARMED:
            self._frozen_setpoint = pd_law.stand(self._samples.q, k_p, k_d)
        elif self.failsafe.mode is Mode.DAMP:
            self._frozen_setpoint = self._sinking.begin(self._setpoint, self._samples.q)
        elif self.failsafe.mode is Mode.HOLD:
            q, most = self._samples.q, self._hold_torque
            self._frozen_setpoint = pd_law.limit_stiffening(self._setpoint, q, self._hold_k_p, most)
        else:
            self._frozen_setpoint = self._setpoint

    def _evaluate(self, now_ns: int) -> Setpoint:
        """Return the setpoint of this instant."""
        mode = self.failsafe.mode
        since_ns = now_ns - self._changed_ns
        if mode is Mode.TRACK:
            command = self.failsafe.command
            assert command is not None  # noqa: S101 - TRACK is entered on fresh commands only
            age_s = (now_ns - command.echo_t_ns) / NS_PER_S
            fresh = pd_law.extrapolate(command, min(age_s, self._aging_max_s))
            if since_ns >= self._blend_ns:
                return fresh
            return pd_law.blend(self._held(since_ns), fresh, since_ns / self._blend_ns)
        if mode is Mode.DAMP:
            near = self._near._replace(stiffen=self._stiffened_ns > 0)
            return self._sinking.law(self._frozen_setpoint, since_ns, self._samples.q, near)
        held = self._held(since_ns)
        if self._stiffened_ns:
            risen = min(1.0, (now_ns - self._stiffened_ns) / self._blend_ns)
            return pd_law.raise_gains(held, self._support_k_p, self._support_k_d, risen)
        return held

    def _held(self, since_ns: int) -> Setpoint:
        """Return HOLD's law: the anchor frozen; some gains rise to the stand gains."""
        moving = max(0.0, 1.0 - since_ns / self._coupled_ramp_ns)
        risen = min(1.0, since_ns / self._blend_ns)
        frozen = pd_law.freeze(self._frozen_setpoint, moving)
        return pd_law.raise_gains(frozen, self._hold_k_p, self._hold_k_d, risen)

    def _event(self, now_ns: int, before: Mode, cause: Cause, tau_before: Pair) -> JointEvent:
        self._events += 1
        return JointEvent(
            t_ns=now_ns,
            seq=self._events,
            mode_before=int(before),
            mode_after=int(self.failsafe.mode),
            cause=int(cause),
            age_ns=self.failsafe.age_ns(now_ns),
            tau_before=tau_before,
            tau_after=self.tau,
        )


def row_of(controller: JointController) -> NeighbourRow:
    """Return what the module's neighbours are told."""
    samples, mode = controller.samples, controller.failsafe.mode
    return NeighbourRow(
        samples.accepted_ns, samples.q[1], samples.v[1], mode, int(controller.caught)
    )
