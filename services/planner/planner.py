"""Runs planner ticks without I/O: six states in, six commands and a status out.

The same object runs live behind the bus, in lockstep under virtual time, and in re-execution from a
log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.planner.controller import Controller, Observation
from services.planner.intents import OperatorRequest
from services.planner.law.assist import Overload, force_up
from services.planner.law.hocca import Hocca, LawOutput
from services.planner.snapshots import TickState
from services.planner.state_phases import StatePhases
from services.planner.watch.controller_guard import ControllerGuard
from services.planner.watch.engagement_fsm import Engagement
from services.planner.watch.limp_leg_watch import LimpLegWatch
from services.planner.watch.plausible import Plausible
from services.planner.watch.rival_watch import RivalWatch
from services.planner.watch.trips import PlannerTrips, values_of
from services.planner.watch.unattended import Unattended
from shared.bus.messages import (
    Attitude,
    JointCommand,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
    SplitSource,
    Vector3,
    Vector6,
    Wrench,
)
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, N_JOINTS, N_MODULES
from shared.robot.hold_rules import Support

Array = NDArray[np.float64]

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
        self._law = Hocca(config)
        self._guard: ControllerGuard | None = None
        if controller is not None:
            self._guard = ControllerGuard(controller, self._law, config.geometry)
        self._plausible = Plausible(config)
        self._engagement = Engagement()
        self._stale_ns = round(config.planner.state_stale_ms * NS_PER_MS)
        self._period_s = 1.0 / config.planner.rate_hz
        self._states: list[JointState | None] = [None] * N_MODULES
        self._arrived_ns = [0] * N_MODULES
        self._q: Array = np.zeros(N_JOINTS)
        self._v: Array = np.zeros(N_JOINTS)
        self._tau: Array = np.zeros(N_JOINTS)
        self._request = OperatorRequest()
        self._wrench: Wrench | None = None
        self._wrench_ns = 0
        self._wrench_stale_ns = round(config.harness.stale_ms * NS_PER_MS)
        self._attitude: Attitude | None = None
        self._attitude_ns = 0
        self._attitude_seq = -1
        self._attitude_stale_ns = round(config.imu.stale_ms * NS_PER_MS)
        self._overload = Overload.of(config.harness)
        self._limp_legs = LimpLegWatch()
        self._rival = RivalWatch()
        self._command_age_ns = round(config.joint_service.max_command_age_ms * NS_PER_MS)
        self._trips = PlannerTrips(config)
        self._unattended = Unattended()
        service = config.joint_service
        self._phases = StatePhases(service.rate_hz, service.state_rate_hz)
        self._support = Support.NONE
        self._wrench_seq = -1
        self._last_ns = 0
        self._new = 0  # bit i: module i has a state that no tick has used
        self._seq = 0
        self._output: LawOutput | None = None
        self._source: SplitSource | None = None
        """Source of the gains of the last tick."""

    @property
    def compares_arrivals(self) -> bool:
        """True if the next states' arrivals count (`services.planner.state_phases`)."""
        return self._phases.compares

    def receive_state(self, module: int, state: JointState, now_ns: int) -> None:
        """Store a module's newest state, if it is plausible."""
        if not self._plausible.is_state(module, state):
            return
        self._states[module] = state
        self._arrived_ns[module] = now_ns
        self._new |= 1 << module
        self._q[2 * module : 2 * module + 2] = state.q
        self._v[2 * module : 2 * module + 2] = state.v
        self._tau[2 * module : 2 * module + 2] = state.tau

    def receive_wrench(self, wrench: Wrench, now_ns: int) -> None:
        """Store the harness's newest wrench, if it is plausible."""
        if not self._plausible.is_wrench(wrench):
            return
        self._wrench_seq = wrench.seq
        self._wrench, self._wrench_ns = wrench, now_ns
        self._overload.receive(wrench, now_ns)

    def receive_attitude(self, attitude: Attitude, now_ns: int) -> None:
        """Store the IMU's newest attitude, if it is plausible."""
        if not self._plausible.is_attitude(attitude):
            return
        self._attitude_seq = attitude.seq
        self._attitude, self._attitude_ns = attitude, now_ns

    def receive_request(self, request: OperatorRequest) -> None:
        """Store the operator's current request (`services.planner.intents`)."""
        self._request = request

    def is_due(self, now_ns: int) -> bool:
        """Return True if a tick is due: as soon as all six modules have a new state.

        Low age matters, because in the open directions only fresh references cancel the local
        gains. On its own timer the planner would let states age for up to a period. Waiting for
        them, it ticks at their rate, and it waits only briefly for late ones.
        """
        since_s = (now_ns - self._last_ns) / NS_PER_S
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
        last_ns = self._last_ns
        dt = min((now_ns - last_ns) / NS_PER_S, TICK_GAP_MAX_S)
        if not last_ns:
            dt = self._period_s
        self._last_ns = now_ns
        self._new = 0
        states = [state for state in self._states if state is not None]
        if len(states) < N_MODULES:
            return []
        fresh = [now_ns - arrived <= self._stale_ns for arrived in self._arrived_ns]
        self._watch_rival([states[i] for i in range(N_MODULES) if fresh[i]])
        engagement = self._engagement
        engagement.advance(
            now_ns,
            fresh,
            [state.ready and state.session == self.session for state in states],
            [state.mode for state in states],
            self._inhibit(),
        )
        self._support = self._limp_legs.advance(now_ns, states)
        self._phases.advance(states, self._arrived_ns, last_ns)
        # until all engage, the law restarts from the measured pose each tick: there is no
        # step
        self._output = self._law.tick(
            self._q,
            self._v,
            self._request.assist_n,
            dt,
            shift_requested=self._request.shift,
            probe=(self._request.probe_row, self._request.probe),
            align=engagement.hold,
            wrench=self._usable_wrench(now_ns),
            up_torso=self._usable_up(now_ns),
        )
        if self._guard is not None:
            self._output = self._controlled(self._guard, self._output, now_ns, dt)
        self._source = self._output.local.source
        loads = self._law.leg_loads(self._tau)
        lifted, leads = self._lifted(now_ns), not engagement.hold
        all_carry = all(state.mode in _CARRIES for state in states)
        is_fresh = engagement.mode is not _WAITING
        known = is_fresh and all_carry and not any(map(math.isnan, loads))
        if known:
            self._law.weigh(self._tau, self._v, self._usable_wrench(now_ns), dt, led=leads)
        else:
            self._law.pause_load_estimate()
        rate = self._law.harness_rate(self._v)
        drift = self._drift(now_ns, lifted)
        values = values_of(self._output, self._q, loads, lifted, rate, drift, leads=leads)
        self._trips.advance(now_ns, values, leads=leads)
        self._seq += 1
        if self._rival.yields:
            return self._announcement(now_ns, states, self._output)
        return self._commands(now_ns, states, self._output)

    def snapshot(self) -> TickState:
        """Return the state between two ticks; `restore` continues from it."""
        return TickState(
            tuple(self._states),
            tuple(self._arrived_ns),
            self._wrench,
            self._wrench_ns,
            self._wrench_seq,
            self._last_ns,
            self._seq,
            self._source,
            self._engagement.copied(),
            self._overload.snapshot(),
            self._law.snapshot(),
            msgspec.structs.replace(self._limp_legs),
            self._attitude,
            self._attitude_ns,
            self._attitude_seq,
            self._trips.snapshot(),
            self._request,
            self._unattended.snapshot(),
            self._phases.snapshot(),
            msgspec.structs.replace(self._rival),
            self._guard.snapshot() if self._guard is not None else None,
            refused=self._plausible.refused,
        )

    def restore(self, snapshot: TickState) -> None:
        """Continue from a state, bit for bit."""
        m = snapshot
        for module, (state, arrived_ns) in enumerate(zip(m.states, m.arrived_ns, strict=True)):
            if state is not None:
                self.receive_state(module, state, arrived_ns)
        self._request, self._plausible.refused = m.request, m.refused
        self._unattended.restore(m.unattended)
        self._phases.restore(m.phases)
        self._wrench, self._wrench_ns, self._wrench_seq = m.wrench, m.wrench_ns, m.wrench_seq
        self._attitude, self._attitude_ns = m.attitude, m.attitude_ns
        self._attitude_seq = m.attitude_seq
        self._last_ns, self._seq, self._source = m.last_ns, m.seq, m.source
        self._engagement = m.engagement.copied()
        self._limp_legs = msgspec.structs.replace(m.limp_legs)
        self._rival = msgspec.structs.replace(m.rival)
        self._overload.restore(m.overload)
        self._law.restore(m.law)
        self._trips.restore(m.trips)
        if self._guard is not None and m.guard is not None:
            self._guard.restore(m.guard)

    def _watch_rival(self, states: Sequence[JointState]) -> None:
        """Find out if another planner leads, and if modules have retired this one's session."""
        if self._rival.advance(self.session, states, self._command_age_ns):
            self.session += 1

    def _announcement(
        self, now_ns: int, states: Sequence[JointState], output: LawOutput
    ) -> list[JointCommand]:
        """Return now and then commands that answer no state: too old, whatever the network does."""
        if not self._rival.announces(now_ns):
            return []
        earlier_ns = 2 * self._command_age_ns
        return [
            msgspec.structs.replace(command, hold=True, echo_t_ns=command.echo_t_ns - earlier_ns)
            for command in self._commands(now_ns, states, output)
        ]

    @property
    def yields(self) -> bool:
        """True while another planner leads, and this one waits."""
        return self._rival.yields

    @property
    def rival(self) -> str:
        """What there is to say of another planner that leads; empty if there is none."""
        return self._rival.describe()

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
            MODULES, states, self._phases.phases, *pairs, strict=True
        ):
            q_ref, v_ref, tau_ff, dtau_ff, tau_coupled, k_p, k_d = row
            command = JointCommand(
                t_ns=now_ns,
                seq=self._seq,
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
            0.0, dt, self._q.copy(), self._v.copy(), self._tau.copy(), law.p, law.pdot,
            self._law.J.copy(), self._law.T.copy(), self._usable_wrench(now_ns), self._request, law,
        )  # fmt: skip
        return guard.act(seen, leads=not self._engagement.hold)

    def _usable_wrench(self, now_ns: int) -> Wrench | None:
        """Return the newest wrench, or None if it is invalid or too old."""
        wrench = self._wrench
        if wrench is None or not wrench.valid or now_ns - self._wrench_ns > self._wrench_stale_ns:
            return None
        return wrench

    def _drift(self, now_ns: int, lifted: float | None) -> float:
        """Return how far the robot has drifted since a hand was last felt, m."""
        wrench, output = self._usable_wrench(now_ns), self._output
        if wrench is None or lifted is None or output is None:
            force = moment = math.nan
        else:
            force, moment = lifted, wrench.moment[1]
        p = output.p.tolist() if output is not None else [0.0] * 6
        return self._unattended.drift(now_ns, (p[2], p[4]), force, moment)

    def _lifted(self, now_ns: int) -> float | None:
        """Return the person's upward force on the robot, N, world; None if it is not known now."""
        wrench, output = self._usable_wrench(now_ns), self._output
        if wrench is None or output is None:
            return None
        return force_up(wrench.force, float(output.p[3]), float(output.p[4]))

    def _usable_up(self, now_ns: int) -> Vector3 | None:
        """Return the unit vector up, torso axes, or None if the newest is invalid or too old."""
        attitude = self._attitude
        if attitude is None or not attitude.valid:
            return None
        return attitude.up if now_ns - self._attitude_ns <= self._attitude_stale_ns else None

    def _inhibit(self) -> PlannerMode | None:
        """Return why the planner may not engage, from the last tick's results; None if it may."""
        if self._rival.yields:
            return PlannerMode.YIELDING
        if self._overload.hold:
            return PlannerMode.OVERLOADED
        if self._law.stance_refused:
            return PlannerMode.MISPLACED
        if self._law.load_refused:
            return PlannerMode.MISLOADED
        if self._source is _UNCERTIFIED:
            return PlannerMode.UNCERTIFIED
        if self._trips.tripped:
            return PlannerMode.TRIPPED
        return None

    def _hold(self) -> bool:
        """Return True if commands carry `hold`.

        It uses this tick's results: without a certificate no gains go to modules in TRACK.
        """
        return self._engagement.hold or self._inhibit() is not None

    def status(self, now_ns: int, tick_us: float) -> PlannerStatus:
        """Return the inputs and decisions of the last tick."""
        output = self._output
        states = self._states
        seqs = [state.seq if state is not None else -1 for state in states]
        ages = [
            now_ns - arrived if state is not None else -1
            for state, arrived in zip(states, self._arrived_ns, strict=True)
        ]
        leads = not self._engagement.hold
        p = pdot = p_ref = closure = stance = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        if output is not None:
            vectors = output.p, output.pdot, output.p_ref, output.closure, output.stance
            p, pdot, p_ref, closure, stance = map(_vector6, vectors)
        return PlannerStatus(
            t_ns=now_ns,
            seq=self._seq,
            session=self.session,
            mode=int(self._engagement.mode) if output is not None else int(PlannerMode.WAITING),
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
            wrench_seq=self._wrench_seq,
            assist_requested_n=self._request.assist_n,
            state_age_ns=(ages[0], ages[1], ages[2], ages[3], ages[4], ages[5]),
            wait_s=0.0 if leads else self._engagement.wait_ns(now_ns) / NS_PER_S,
            attitude_seq=self._attitude_seq,
            slope=output.slope if output is not None else (0.0, 0.0),
            shift_requested=self._request.shift,
            load=self._law.load,
            requested_by=self._request.source,
            probe_row=self._request.probe_row,
            probe=self._request.probe,
            stance=stance,
            why=self._rival.describe()
            or self._law.stance_refusal()
            or self._law.load_refusal()
            or self._trips.why
            or (self._guard.why if self._guard is not None else ""),
            trip=int(self._trips.tripped),
            refused=self._plausible.refused,
        )


def _listed(values: Array) -> list[float]:
    numbers: list[float] = values.tolist()
    return numbers


def _vector6(values: Array) -> Vector6:
    a, b, c, d, e, f = values.tolist()
    return a, b, c, d, e, f
