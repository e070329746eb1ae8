"""Runs planner ticks without I/O: six states in, six commands and a status out.

The same object runs live behind the bus, in lockstep under virtual time, and in re-execution from a
log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from services.planner.controller import Controller, Observation
from services.planner.intents import OperatorRequest
from services.planner.law.assist import Overload, OverloadState, force_up
from services.planner.law.height import Toward
from services.planner.law.hocca import Hocca, LawOutput, LawState
from services.planner.state_phases import PhasesState, StatePhases
from services.planner.watch.controller_guard import ControllerGuard, GuardState
from services.planner.watch.engagement_fsm import Engagement
from services.planner.watch.harness_trust import HarnessTrust
from services.planner.watch.heat import HeatWatch, HeatWatchState
from services.planner.watch.limp_leg_watch import LimpLegWatch
from services.planner.watch.plausible import Plausible
from services.planner.watch.rival_watch import RivalWatch
from services.planner.watch.soles import Soles
from services.planner.watch.supply import SupplyState, SupplyWatch
from services.planner.watch.trips import PlannerTrips, TripsState, values_of
from services.planner.watch.unattended import Unattended, UnattendedState
from shared.arrays import Array
from shared.bus.messages import (
    Attitude,
    JointCommand,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
    SplitSource,
    Tare,
    Vector3,
    Vector6,
    Wrench,
)
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, N_JOINTS, N_MODULES
from shared.robot.hold_rules import Support
from shared.state import copied

EARLY_FRACTION = 0.5
"""Fraction of a period; states that arrive sooner after a tick still belong to that tick."""
LATE_FRACTION = 1.25
"""Fraction of a period after which the planner ticks with the states it has."""
TICK_GAP_MAX_S = 0.02
"""A longer gap between ticks (a stopped process) is not integrated over."""

_ALL_NEW = (1 << N_MODULES) - 1
# Compared in each tick: docs/contributing.md, The control path.
_CARRIES = (int(Mode.HOLD), int(Mode.TRACK))
_WAITING, _UNCERTIFIED = PlannerMode.WAITING, SplitSource.UNCERTIFIED


class PlannerState(msgspec.Struct, kw_only=True):
    """State of `Planner` between two ticks; one of six entries for each module."""

    states: list[JointState | None] = msgspec.field(default_factory=lambda: [None] * N_MODULES)
    arrived_ns: list[int] = msgspec.field(default_factory=lambda: [0] * N_MODULES)
    wrench: Wrench | None = None
    wrench_ns: int = 0
    wrench_seq: int = -1
    last_ns: int = 0
    """Time of the last tick."""
    seq: int = 0
    source: SplitSource | None = None
    """Source of the gains of the last tick."""
    engagement: Engagement = msgspec.field(default_factory=Engagement)
    overload: OverloadState = msgspec.field(default_factory=OverloadState)
    law: LawState = msgspec.field(default_factory=LawState)
    limp_legs: LimpLegWatch = msgspec.field(default_factory=LimpLegWatch)
    attitude: Attitude | None = None
    attitude_ns: int = 0
    attitude_seq: int = -1
    trips: TripsState = msgspec.field(default_factory=TripsState)
    request: OperatorRequest = OperatorRequest()
    unattended: UnattendedState = msgspec.field(default_factory=UnattendedState)
    trust: HarnessTrust = msgspec.field(default_factory=HarnessTrust)
    phases: PhasesState = msgspec.field(default_factory=PhasesState)
    rival: RivalWatch = msgspec.field(default_factory=RivalWatch)
    heat: HeatWatchState = msgspec.field(default_factory=HeatWatchState)
    supply: SupplyState = msgspec.field(default_factory=SupplyState)
    guard: GuardState | None = None
    """None without a controller of somebody's own."""
    refused: int = 0
    """Implausible measurements so far."""


class _Ages(NamedTuple):
    """Largest ages of what is used, ns."""

    state: int
    wrench: int
    attitude: int
    command: int


class Planner:
    """Whole-body law behind its engagement rule."""

    def __init__(
        self, config: RobotConfig, session: int, controller: Controller | None = None
    ) -> None:
        """Start waiting for six fresh states.

        Args:
            config: the robot.
            session: drawn at random at each start; sent in every command.
            controller: in the place of the shipped law; its own state is in no snapshot.
        """
        self.session = session
        if controller is not None:  # an integral of the law would wind up against it
            law = msgspec.structs.replace(config.law, push_integral_max=0.0)
            config = msgspec.structs.replace(config, law=law)
        self._law = Hocca(config)
        self._guard: ControllerGuard | None = None
        if controller is not None:
            self._guard = ControllerGuard(controller, self._law, config.geometry)
        self._plausible = Plausible(config)
        self._overload = Overload(config.harness)
        self._trips = PlannerTrips(config)
        self._soles = Soles(config)
        self._unattended = Unattended()
        self._heat = HeatWatch(config.heat)
        self._supply = SupplyWatch(config.supply)
        service = config.joint_service
        self._phases = StatePhases(service.rate_hz, service.state_rate_hz)
        self._period_s = 1.0 / config.planner.rate_hz
        self._ages = _Ages(
            state=round(config.planner.state_stale_ms * NS_PER_MS),
            wrench=round(config.harness.stale_ms * NS_PER_MS),
            attitude=round(config.imu.stale_ms * NS_PER_MS),
            command=round(service.max_command_age_ms * NS_PER_MS),
        )
        self._state = PlannerState(
            overload=self._overload.state,
            trips=self._trips.state,
            unattended=self._unattended.state,
            phases=self._phases.state,
            heat=self._heat.state,
            supply=self._supply.state,
            guard=None if self._guard is None else self._guard.state,
        )
        self._q: Array = np.zeros(N_JOINTS)
        self._v: Array = np.zeros(N_JOINTS)
        self._tau: Array = np.zeros(N_JOINTS)
        self._new = 0  # bit i: module i has a state that no tick has used
        self._support = Support.NONE
        self._output: LawOutput | None = None

    @property
    def compares_arrivals(self) -> bool:
        """True if the next states' arrivals count (`services.planner.state_phases`)."""
        return self._phases.compares

    def receive_state(self, module: int, state: JointState, now_ns: int) -> None:
        """Store a module's newest state, if it is plausible."""
        if not self._plausible.is_state(module, state):
            return
        self._state.states[module] = state
        self._state.arrived_ns[module] = now_ns
        self._new |= 1 << module
        self._q[2 * module : 2 * module + 2] = state.q
        self._v[2 * module : 2 * module + 2] = state.v
        self._tau[2 * module : 2 * module + 2] = state.tau

    def receive_wrench(self, wrench: Wrench, now_ns: int) -> None:
        """Store the harness's newest wrench, if it is plausible."""
        if not self._plausible.is_wrench(wrench):
            return
        self._state.wrench_seq = wrench.seq
        self._state.wrench, self._state.wrench_ns = wrench, now_ns
        self._overload.receive(wrench, now_ns)

    def receive_attitude(self, attitude: Attitude, now_ns: int) -> None:
        """Store the IMU's newest attitude, if it is plausible."""
        if not self._plausible.is_attitude(attitude):
            return
        self._state.attitude_seq = attitude.seq
        self._state.attitude, self._state.attitude_ns = attitude, now_ns

    def receive_request(self, request: OperatorRequest) -> None:
        """Store the operator's current request (`services.planner.intents`)."""
        self._state.request = request

    def is_due(self, now_ns: int) -> bool:
        """Return True if a tick is due: as soon as all six modules have a new state.

        Low age matters, because in the open directions only fresh references cancel the local
        gains. On its own timer the planner would let states age for up to a period. Waiting for
        them, it ticks at their rate, and it waits only briefly for late ones.
        """
        since_s = (now_ns - self._state.last_ns) / NS_PER_S
        if self._new == _ALL_NEW:
            return since_s >= EARLY_FRACTION * self._period_s
        return since_s >= LATE_FRACTION * self._period_s

    def tick(self, now_ns: int) -> list[JointCommand]:
        """Run the law; return six commands.

        None until every module has sent a state. While another planner leads none that a module
        would accept, and those rarely.

        Args:
            now_ns: the planner's monotonic clock.
        """
        last_ns = self._state.last_ns
        dt = min((now_ns - last_ns) / NS_PER_S, TICK_GAP_MAX_S)
        if not last_ns:
            dt = self._period_s
        self._state.last_ns = now_ns
        self._new = 0
        states = [state for state in self._state.states if state is not None]
        if len(states) < N_MODULES:
            return []
        fresh = [now_ns - arrived <= self._ages.state for arrived in self._state.arrived_ns]
        self._watch_rival([states[i] for i in range(N_MODULES) if fresh[i]])
        engagement = self._state.engagement
        engagement.advance(
            now_ns,
            fresh,
            [state.ready and state.session == self.session for state in states],
            [state.mode for state in states],
            self._inhibit(),
        )
        self._support = self._state.limp_legs.advance(now_ns, states)
        self._phases.advance(states, self._state.arrived_ns, last_ns)
        request = self._state.request
        tare = Tare.DONE if self._state.wrench is None else self._state.wrench.tare
        trusted = self._state.trust.advance(
            self._law.load.state, tare, dt, leads=not engagement.hold
        )
        heat = self._heat.advance(now_ns, states, trusted * request.assist_n, dt)
        self._supply.advance(states, dt)
        # until all engage, the law restarts from the measured pose each tick: there is no
        # step
        self._output = self._law.tick(
            self._q,
            self._v,
            heat.assist,
            dt,
            shift_requested=request.shift,
            toward=self._toward(heat.toward),
            released=self._state.unattended.released,
            pitch_drive=self._state.unattended.pitch.drive,
            align=engagement.hold,
            wrench=self._usable_wrench(now_ns),
            up_torso=self._usable_up(now_ns),
        )
        if self._guard is not None:
            self._output = self._controlled(self._guard, self._output, now_ns, dt)
        self._state.source = self._output.local.source
        loads = self._law.measured.leg_loads(self._tau)
        lifted, leads = self._lifted(now_ns), not engagement.hold
        self._heat.state.lifted = lifted
        all_carry = all(state.mode in _CARRIES for state in states)
        is_fresh = engagement.mode is not _WAITING
        known = is_fresh and all_carry and not any(map(math.isnan, loads))
        if known:
            self._law.weigh(self._tau, self._v, self._usable_wrench(now_ns), dt, led=leads)
        else:
            self._law.load.pause()
        soles = self._soles.loads(loads)
        edge = self._soles.edge(self._tau, soles)
        rate = self._law.harness_rate(self._v)
        drift = self._drift(now_ns, lifted, leads=leads)
        moves = self._heat.moves
        values = values_of(
            self._output, self._q, soles, edge, lifted, rate, drift, leads=leads, moves=moves
        )
        self._trips.advance(now_ns, values, leads=leads)
        self._state.seq += 1
        if self._state.rival.yields:
            return self._announcement(now_ns, states, self._output)
        return self._commands(now_ns, states, self._output)

    def snapshot(self) -> PlannerState:
        """Return a copy of the state between two ticks; `restore` continues from it."""
        refused = self._plausible.refused
        return copied(
            msgspec.structs.replace(self._state, law=self._law.snapshot(), refused=refused)
        )

    def restore(self, snapshot: PlannerState) -> None:
        """Continue from a copy of a state, bit for bit."""
        self._state = own = copied(snapshot)
        for module, (state, arrived_ns) in enumerate(zip(own.states, own.arrived_ns, strict=True)):
            if state is not None:
                self.receive_state(module, state, arrived_ns)
        self._plausible.refused = own.refused
        self._law.restore(own.law)
        self._overload.state = own.overload
        self._trips.restore(own.trips)
        self._unattended.state, self._phases.state = own.unattended, own.phases
        self._heat.state = own.heat
        self._supply.state = own.supply
        if self._guard is not None:
            if own.guard is not None:
                self._guard.state = own.guard
            own.guard = self._guard.state

    def _watch_rival(self, states: Sequence[JointState]) -> None:
        """Find out if another planner leads, and if modules have retired this one's session."""
        if self._state.rival.advance(self.session, states, self._ages.command):
            self.session += 1

    def _announcement(
        self, now_ns: int, states: Sequence[JointState], output: LawOutput
    ) -> list[JointCommand]:
        """Return now and then commands that answer no state: too old, whatever the network does."""
        if not self._state.rival.announces(now_ns):
            return []
        earlier_ns = 2 * self._ages.command
        return [
            msgspec.structs.replace(command, hold=True, echo_t_ns=command.echo_t_ns - earlier_ns)
            for command in self._commands(now_ns, states, output)
        ]

    @property
    def yields(self) -> bool:
        """True while another planner leads, and this one waits."""
        return self._state.rival.yields

    @property
    def rival(self) -> str:
        """What there is to say of another planner that leads; empty if there is none."""
        return self._state.rival.describe()

    def _commands(
        self, now_ns: int, states: Sequence[JointState], output: LawOutput
    ) -> list[JointCommand]:
        """Return the tick's six commands; each echoes the stamp of its module's state."""
        local, hold, support = output.local, self._hold(), self._support
        margins = local.margins
        arrays = (
            output.q_ref, output.v_ref, output.tau_ff, output.dtau_ff, output.tau_coupled,
            local.D, local.D_B,
        )  # fmt: skip
        pairs = [list(zip(row[::2], row[1::2], strict=True)) for row in map(_listed, arrays)]
        commands = []
        for module, state, phase, *row in zip(
            MODULES, states, self._state.phases.phases, *pairs, strict=True
        ):
            q_ref, v_ref, tau_ff, dtau_ff, tau_coupled, k_p, k_d = row
            command = JointCommand(
                t_ns=now_ns,
                seq=self._state.seq,
                session=self.session,
                echo_t_ns=state.t_ns,
                hold=hold,
                q_ref=q_ref,
                v_ref=v_ref,
                tau_ff=tau_ff,
                dtau_ff=dtau_ff,
                tau_coupled=tau_coupled,
                k_p=k_p,
                k_d=k_d,
                margin=margins.service,
                margin_onboard=margins.onboard,
                stiffen=support.includes(module),
                state_phase=phase,
            )
            commands.append(command)
        return commands

    def _controlled(
        self, guard: ControllerGuard, law: LawOutput, now_ns: int, dt: float
    ) -> LawOutput:
        """Return the output of somebody's own controller in the place of the law's."""
        seen = Observation(
            time_s=0.0,
            dt=dt,
            q=self._q.copy(),
            v=self._v.copy(),
            tau=self._tau.copy(),
            p=law.p,
            pdot=law.pdot,
            J=self._law.measured.J.copy(),
            T=self._law.reference.T.copy(),
            wrench=self._usable_wrench(now_ns),
            request=self._state.request,
            law=law,
        )
        return guard.act(seen, leads=not self._state.engagement.hold)

    def _usable_wrench(self, now_ns: int) -> Wrench | None:
        """Return the newest wrench, or None if it is invalid, too old or not believed."""
        s = self._state
        wrench = s.wrench
        if wrench is None or not wrench.valid or s.trust.doubted:
            return None
        return wrench if now_ns - s.wrench_ns <= self._ages.wrench else None

    def _drift(self, now_ns: int, lifted: float | None, *, leads: bool) -> float:
        """Return how far the robot has drifted since a hand was last felt, m."""
        wrench, output = self._usable_wrench(now_ns), self._output
        hand = math.nan, math.nan
        p = pdot = [0.0] * 6
        if output is not None:
            p, pdot = output.p.tolist(), output.pdot.tolist()
            if wrench is not None and lifted is not None and not self._sits:
                hand = lifted + output.assist, wrench.moment[1]
        return self._unattended.advance(now_ns, (p[2], p[4]), (pdot[2], pdot[4]), hand, leads=leads)

    def _toward(self, heat: Toward) -> Toward:
        """Return where the robot goes by itself; what is too warm goes first."""
        return Toward.DOWN if heat is Toward.PERSON and self._sits else heat

    @property
    def _sits(self) -> bool:
        """True while the robot is to go down by itself."""
        return self._state.request.sit or self._supply.state.sits

    def _lifted(self, now_ns: int) -> float | None:
        """Return the person's upward force on the robot, N, world; None if it is not known now."""
        wrench, output = self._usable_wrench(now_ns), self._output
        if wrench is None or output is None:
            return None
        return force_up(wrench.force, float(output.p[3]), float(output.p[4]))

    def _usable_up(self, now_ns: int) -> Vector3 | None:
        """Return the unit vector up, torso axes, or None if the newest is invalid or too old."""
        attitude = self._state.attitude
        if attitude is None or not attitude.valid:
            return None
        return attitude.up if now_ns - self._state.attitude_ns <= self._ages.attitude else None

    def _inhibit(self) -> PlannerMode | None:
        """Return why the planner may not engage, from the last tick's results; None if it may."""
        if self._state.rival.yields:
            return PlannerMode.YIELDING
        if self._overload.state.hold:
            return PlannerMode.OVERLOADED
        if self._law.stance.refused:
            return PlannerMode.MISPLACED
        if self._law.load.refused:
            return PlannerMode.MISLOADED
        if self._state.source is _UNCERTIFIED:
            return PlannerMode.UNCERTIFIED
        if self._trips.state.tripped:
            return PlannerMode.TRIPPED
        return None

    def _hold(self) -> bool:
        """Return True if commands carry `hold`.

        It uses this tick's results: without a certificate no gains go to modules in TRACK.
        """
        return self._state.engagement.hold or self._inhibit() is not None

    def _why(self) -> str:
        """Return what the person must know: of the supply, of heat, and why it does not lead."""
        refusal = (
            self._state.rival.describe()
            or self._law.stance.refusal()
            or self._law.load.refusal()
            or self._trips.state.why
            or self._heat.describe()
            or self._unattended.describe()
            or (self._guard.state.why if self._guard is not None else "")
        )
        parts = self._supply.describe(), self._state.trust.describe(), refusal
        return "; ".join(filter(None, parts))

    def status(self, now_ns: int, tick_us: float) -> PlannerStatus:
        """Return the inputs and decisions of the last tick."""
        s, output, load = self._state, self._output, self._law.load.state
        seqs = [state.seq if state is not None else -1 for state in s.states]
        ages = [
            now_ns - arrived if state is not None else -1
            for state, arrived in zip(s.states, s.arrived_ns, strict=True)
        ]
        leads = not s.engagement.hold
        p = pdot = p_ref = closure = stance = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        if output is not None:
            vectors = output.p, output.pdot, output.p_ref, output.closure, output.stance
            p, pdot, p_ref, closure, stance = map(_vector6, vectors)
        return PlannerStatus(
            t_ns=now_ns,
            seq=s.seq,
            session=self.session,
            mode=int(s.engagement.mode) if output is not None else int(PlannerMode.WAITING),
            hold=self._hold(),
            p=p,
            pdot=pdot,
            p_ref=p_ref,
            closure=closure,
            assist_n=output.assist if output is not None else 0.0,
            margin=output.local.margins.service if output is not None else 0.0,
            margin_onboard=output.local.margins.onboard if output is not None else 0.0,
            split=int(output.local.source) if output is not None else int(SplitSource.DIAGONAL),
            ik_iterations=output.ik_iterations if output is not None else 0,
            ik_residual=output.ik_residual if output is not None else 0.0,
            tick_us=tick_us,
            state_seq=(seqs[0], seqs[1], seqs[2], seqs[3], seqs[4], seqs[5]),
            wrench_seq=s.wrench_seq,
            assist_requested_n=s.request.assist_n,
            state_age_ns=(ages[0], ages[1], ages[2], ages[3], ages[4], ages[5]),
            wait_s=0.0 if leads else s.engagement.wait_ns(now_ns) / NS_PER_S,
            attitude_seq=s.attitude_seq,
            slope=output.slope if output is not None else (0.0, 0.0),
            shift_requested=s.request.shift,
            load=(load.kg, load.a, load.b),
            requested_by=s.request.source,
            stance=stance,
            why=self._why(),
            trip=int(self._trips.state.tripped),
            refused=self._plausible.refused,
            sit=s.request.sit,
            heat=int(self._heat.state.action),
            heat_left_s=self._heat.state.left_s,
            supply_v=s.supply.volts,
        )


def _listed(values: Array) -> list[float]:
    numbers: list[float] = values.tolist()
    return numbers


def _vector6(values: Array) -> Vector6:
    a, b, c, d, e, f = values.tolist()
    return a, b, c, d, e, f
