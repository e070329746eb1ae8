"""Planner ticks without I/O: six states in, six commands and a status out.

The same object runs live behind the bus, in lockstep under virtual time, and in re-execution from a
log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from services.planner.controller import Controller, Observation
from services.planner.intents import OperatorRequest
from services.planner.law.assist import Overload, OverloadState, force_up
from services.planner.law.closed_reference import Toward
from services.planner.law.feet import Soles
from services.planner.law.hocca import KNEES, Hocca, LawInputs, LawOutput, LawState
from services.planner.law.load import LoadState
from services.planner.state_phases import PhasesState, StatePhases
from services.planner.watch.controller_guard import ControllerGuard, GuardState
from services.planner.watch.engagement_fsm import Engagement, LimpLegWatch, RivalWatch
from services.planner.watch.fallen import FallState, FallWatch, Seen
from services.planner.watch.park import SHED_RATE, ParkLaw, ParkState, Touch
from services.planner.watch.plausible import HarnessTrust, Plausible
from services.planner.watch.reserves import HeatWatch, HeatWatchState, SupplyState, SupplyWatch
from services.planner.watch.trips import PlannerTrips, TripsState, values_of
from services.planner.watch.unattended import Unattended
from shared.arrays import Array, rounded_rows, vector6
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
    Vector4,
    Wrench,
)
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULES, N_MODULES
from shared.robot.hold_rules import Support
from shared.rounding import FORCE, POSITION, RATE, rounded

EARLY_FRACTION = 0.5
"""Minimum time between two ticks, as a fraction of a period."""
LATE_FRACTION = 1.25
"""Fraction of a period after the last tick at which the planner ticks with the states it has."""
TICK_GAP_MAX_S = 0.02
"""Maximum integration step, s; a longer gap between ticks means a stopped process."""

_ALL_NEW = (1 << N_MODULES) - 1
# Constants, because each tick compares them (docs/contributing.md, The control path).
_CARRIES = (int(Mode.HOLD), int(Mode.TRACK))
_WAITING, _UNCERTIFIED = PlannerMode.WAITING, SplitSource.UNCERTIFIED
_OF_COMMANDS: Final = (POSITION, RATE, FORCE, FORCE, FORCE, FORCE, FORCE)
_OF_STATUS: Final = (POSITION, RATE, POSITION, POSITION, POSITION)


class PlannerState(msgspec.Struct, kw_only=True):
    """State of `Planner` between ticks; lists have one entry per module."""

    states: list[JointState | None] = msgspec.field(default_factory=lambda: [None] * N_MODULES)
    arrived_ns: list[int] = msgspec.field(default_factory=lambda: [0] * N_MODULES)
    new: int = 0
    """Bit i: module i has a state that no tick has used yet."""
    wrench: Wrench | None = None
    wrench_ns: int = 0
    attitude: Attitude | None = None
    attitude_ns: int = 0
    request: OperatorRequest = OperatorRequest()
    refused: int = 0
    """Number of implausible measurements so far."""
    last_ns: int = 0
    """Time of the last tick."""
    seq: int = 0
    source: SplitSource | None = None
    """Source of the gains of the last tick."""
    rival: RivalWatch = msgspec.field(default_factory=RivalWatch)
    engagement: Engagement = msgspec.field(default_factory=Engagement)
    overload: OverloadState = msgspec.field(default_factory=OverloadState)
    limp_legs: LimpLegWatch = msgspec.field(default_factory=LimpLegWatch)
    support: Support = Support.NONE
    """Modules that stiffen for a limp one."""
    phases: PhasesState = msgspec.field(default_factory=PhasesState)
    trust: HarnessTrust = msgspec.field(default_factory=HarnessTrust)
    heat: HeatWatchState = msgspec.field(default_factory=HeatWatchState)
    supply: SupplyState = msgspec.field(default_factory=SupplyState)
    law: LawState = msgspec.field(default_factory=LawState)
    guard: GuardState = msgspec.field(default_factory=GuardState)
    """Changes only if a custom controller runs."""
    unattended: Unattended = msgspec.field(default_factory=Unattended)
    trips: TripsState = msgspec.field(default_factory=TripsState)
    fall: FallState = msgspec.field(default_factory=FallState)
    led: Vector4 = (0.0, 0.0, 0.0, 0.0)
    """COM height, m, and pitch, rad, of the last tick, and their rates."""
    park: ParkState = msgspec.field(default_factory=ParkState)
    """Changes only if the robot may park."""


class Inputs(NamedTuple):
    """Measurements and requests that one tick uses."""

    now_ns: int
    dt: float
    """Time since the last tick, s."""
    states: list[JointState]
    """Newest state of each module, of any age."""
    fresh: list[bool]
    """Per module, True if its state arrived within `planner.state_stale_ms`."""
    q: Array
    """(12,), rad"""
    v: Array
    """(12,), rad/s"""
    tau: Array
    """(12,), N m"""
    wrench: Wrench | None
    """Newest wrench of the harness; None if invalid or stale."""
    up: Vector3 | None
    """Unit vector against gravity, torso axes; None if invalid or stale."""
    turning: Vector3 | None
    """Angular velocity of the torso from the IMU, rad/s, torso axes; None if `up` is None."""
    request: OperatorRequest


class _Ages(NamedTuple):
    """Maximum ages of inputs and commands, ns."""

    state: int
    wrench: int
    attitude: int
    command: int


class Planner:
    """The planner without I/O: the whole-body law, and the decision whether it leads.

    Attributes:
        session: random number drawn at the start, plus 1 each time modules refuse it for good; sent
            in every command.
        state: everything that changes between ticks. A snapshot is a copy of it
            (`shared.state.copied`), from which another planner continues bit for bit. A custom
            controller's own state is not part of it.
    """

    def __init__(
        self, config: RobotConfig, session: int, controller: Controller | None = None
    ) -> None:
        """Start waiting for six fresh states.

        Args:
            config: the robot.
            session: number drawn at random.
            controller: replaces the shipped law.
        """
        self.session = session
        self.state = PlannerState()
        if controller is not None:  # otherwise the push integral would wind up against it
            law = msgspec.structs.replace(config.law, push_integral_max=0.0)
            config = msgspec.structs.replace(config, law=law)
        self._law = Hocca(config)
        self._guard: ControllerGuard | None = None
        if controller is not None:
            self._guard = ControllerGuard(controller, self._law, config.geometry)
        self._plausible = Plausible(config)
        self._overload = Overload(config.harness)
        self._trips = PlannerTrips(config)
        self._fall = FallWatch(config)
        self._park = ParkLaw(config.park, config.assist)
        self._soles = Soles(config)
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
        self._payload = config.mass.payload
        self._output: LawOutput | None = None

    @property
    def compares_arrivals(self) -> bool:
        """True if the next states' arrivals will be compared (`services.planner.state_phases`)."""
        return self._phases.compares(self.state.phases)

    def receive_state(self, module: int, state: JointState, now_ns: int) -> None:
        """Store a module's newest state, if it is plausible."""
        s = self.state
        if not self._plausible.is_state(module, state):
            s.refused += 1
            return
        s.states[module], s.arrived_ns[module] = state, now_ns
        s.new |= 1 << module

    def receive_wrench(self, wrench: Wrench, now_ns: int) -> None:
        """Store the harness's newest wrench, if it is plausible."""
        s = self.state
        if not self._plausible.is_wrench(wrench):
            s.refused += 1
            return
        s.wrench, s.wrench_ns = wrench, now_ns
        self._overload.receive(s.overload, wrench, now_ns)

    def receive_attitude(self, attitude: Attitude, now_ns: int) -> None:
        """Store the IMU's newest attitude, if it is plausible."""
        s = self.state
        if not self._plausible.is_attitude(attitude):
            s.refused += 1
            return
        s.attitude, s.attitude_ns = attitude, now_ns

    def receive_request(self, request: OperatorRequest) -> None:
        """Store the operator's current request (`services.planner.intents`)."""
        self.state.request = request

    def is_due(self, now_ns: int) -> bool:
        """Return True if a tick is due: as soon as all six modules have a new state.

        Low age matters, because in the open directions only fresh references cancel the local
        gains. With its own timer, the planner would let states age by up to a period. So it waits
        for the states and ticks at their rate, but waits only briefly for late ones.
        """
        since_s = (now_ns - self.state.last_ns) / NS_PER_S
        if self.state.new == _ALL_NEW:
            return since_s >= EARLY_FRACTION * self._period_s
        return since_s >= LATE_FRACTION * self._period_s

    def tick(self, now_ns: int) -> list[JointCommand]:
        """Run the law; return six commands.

        The list is empty until every module has sent a state. While another planner leads, it is
        empty or an announcement, which every module refuses.

        Args:
            now_ns: the planner's monotonic clock.
        """
        s, last_ns = self.state, self.state.last_ns
        inputs = self._inputs(now_ns)
        s.last_ns, s.new = now_ns, 0
        if inputs is None:
            return []
        self._decide(inputs, last_ns)
        load = s.law.load
        tare = Tare.DONE if s.wrench is None else s.wrench.tare
        trusted = s.trust.advance(load, tare, inputs.dt, leads=not s.engagement.hold)
        if s.trust.doubted:
            inputs = inputs._replace(wrench=None)
        self._output = output = self._run_law(inputs, trusted * inputs.request.assist_n)
        s.source = output.local.source
        self._watch(inputs, output)
        s.seq += 1
        if not s.rival.yields:
            return self._commands(inputs, output)
        return self._announcement(inputs, output)

    def _inputs(self, now_ns: int) -> Inputs | None:
        """Return the inputs of a tick; None until every module has sent a state."""
        s, ages = self.state, self._ages
        states = [state for state in s.states if state is not None]
        if len(states) < N_MODULES:
            return None
        dt = min((now_ns - s.last_ns) / NS_PER_S, TICK_GAP_MAX_S) if s.last_ns else self._period_s
        wrench, attitude = s.wrench, s.attitude
        if wrench is not None and not (wrench.valid and now_ns - s.wrench_ns <= ages.wrench):
            wrench = None
        up = turning = None
        if attitude is not None and attitude.valid and now_ns - s.attitude_ns <= ages.attitude:
            up, turning = attitude.up, attitude.rate
        return Inputs(
            now_ns,
            dt,
            states,
            fresh=[now_ns - arrived <= ages.state for arrived in s.arrived_ns],
            q=np.array([state.q for state in states]).ravel(),
            v=np.array([state.v for state in states]).ravel(),
            tau=np.array([state.tau for state in states]).ravel(),
            wrench=wrench,
            up=up,
            turning=turning,
            request=s.request,
        )

    def _decide(self, inputs: Inputs, last_ns: int) -> None:
        """Decide who leads, which modules stiffen, and when each sends its states."""
        s, states = self.state, inputs.states
        recent = [state for state, fresh in zip(states, inputs.fresh, strict=True) if fresh]
        if s.rival.advance(self.session, recent, self._ages.command):
            self.session += 1  # modules have retired this session
        s.engagement.advance(
            inputs.now_ns,
            inputs.fresh,
            [state.ready and state.session == self.session for state in states],
            [state.mode for state in states],
            self._inhibit(),
        )
        s.support = s.limp_legs.advance(inputs.now_ns, states)
        self._phases.advance(s.phases, states, s.arrived_ns, last_ns)

    def _run_law(self, inputs: Inputs, assist_requested: float) -> LawOutput:
        """Return the output of the law, or of a custom controller in its place."""
        s, dt = self.state, inputs.dt
        if self._park.enabled:
            parked = s.trust.scale * self._parked_assist(inputs)
            assist_requested = max(assist_requested, parked)
        heat = self._heat.advance(s.heat, inputs.now_ns, inputs.states, assist_requested, dt)
        self._supply.advance(s.supply, inputs.states, dt)
        height, pitch = s.unattended.released
        output = self._law.tick(
            s.law,
            LawInputs(
                inputs.q,
                inputs.v,
                dt,
                assist=heat.assist,
                shed_rate=SHED_RATE if s.park.closed else 0.0,
                shift=inputs.request.shift,
                toward=self._toward(heat.toward),
                released=(height or s.park.closed, pitch or s.park.closed),
                pitch_drive=s.unattended.pitch.drive,
                # until the planner leads, each tick restarts the law, so engaging makes no step
                align=s.engagement.hold,
                wrench=inputs.wrench,
                up_torso=inputs.up,
            ),
        )
        if self._guard is None:
            return output
        seen = Observation(
            time_s=0.0,
            dt=dt,
            q=inputs.q,
            v=inputs.v,
            tau=inputs.tau,
            p=output.p,
            pdot=output.pdot,
            J=self._law.measured.J.copy(),
            T=self._law.reference.T.copy(),
            wrench=inputs.wrench,
            request=inputs.request,
            law=output,
        )
        return self._guard.act(s.guard, seen, leads=not s.engagement.hold)

    def _parked_assist(self, inputs: Inputs) -> float:
        """Return the assist that a parked robot gives, N; decide whether it is parked."""
        s, wrench = self.state, inputs.wrench
        touch = None
        if wrench is not None and s.heat.lifted is not None:
            right, left = KNEES
            knee = max(float(inputs.q[right]), float(inputs.q[left]))
            kg = s.law.load.kg - s.trust.load[0]
            z, pitch, z_rate, pitch_rate = s.led
            height = s.law.height
            sinks = height.hold[0] * (height.height - z)
            touch = Touch(
                s.heat.lifted, wrench.moment[1], wrench.force[:2],
                (knee, pitch, kg), (z_rate, pitch_rate), sinks,
            )  # fmt: skip
        may = not s.engagement.hold and inputs.request.assist_n == 0.0
        may = may and not self._sits and not s.heat.moves
        park = inputs.request.park
        return self._park.advance(s.park, inputs.now_ns, touch, park, inputs.dt, may=may)

    def _watch(self, inputs: Inputs, output: LawOutput) -> None:
        """Estimate the load; check for drift, trips and a fall."""
        s, wrench, leads = self.state, inputs.wrench, not self.state.engagement.hold
        lifted = None
        if wrench is not None:
            lifted = force_up(wrench.force, float(output.p[3]), float(output.p[4]))
        s.heat.lifted = lifted
        loads = self._law.measured.leg_loads(inputs.tau)
        all_carry = all(state.mode in _CARRIES for state in inputs.states)
        is_fresh = s.engagement.mode is not _WAITING
        if is_fresh and all_carry and not any(map(math.isnan, loads)):
            self._law.weigh(s.law.load, inputs.tau, inputs.v, wrench, inputs.dt, led=leads)
        else:
            s.law.load.rates = None
        hand = math.nan, math.nan
        if wrench is not None and lifted is not None and not self._sits:
            hand = lifted + output.assist, wrench.moment[1]
        pose, rates = output.p.tolist(), output.pdot.tolist()
        s.led = (pose[2], pose[4], rates[2], rates[4])
        drift = s.unattended.advance(
            inputs.now_ns, (pose[2], pose[4]), (rates[2], rates[4]), hand, leads=leads
        )
        soles = self._soles.loads(loads)
        values = values_of(
            output,
            inputs.q,
            soles,
            self._soles.edge(inputs.tau, soles),
            lifted,
            self._law.harness_rate(inputs.v),
            drift,
            leads=leads,
            moves=s.heat.moves,
        )
        self._trips.advance(s.trips, inputs.now_ns, values, leads=leads)
        if s.law.has_led:
            tipping = self._soles.tipping(inputs.tau, soles)
            closure, up, turning = output.closure.tolist(), inputs.up, inputs.turning
            seen = Seen(pose, rates, closure, soles, tipping, up, turning)
            modes = [state.mode for state in inputs.states]
            if self._fall.advance(s.fall, inputs.now_ns, modes, seen):
                s.law.load, s.law.has_led, s.trust = LoadState(), False, HarnessTrust()

    def _announcement(self, inputs: Inputs, output: LawOutput) -> list[JointCommand]:
        """Return, if due, commands that every module refuses because their echo is too old."""
        if not self.state.rival.announces(inputs.now_ns):
            return []
        earlier_ns = 2 * self._ages.command
        return [
            msgspec.structs.replace(command, hold=True, echo_t_ns=command.echo_t_ns - earlier_ns)
            for command in self._commands(inputs, output)
        ]

    @property
    def yields(self) -> bool:
        """True while another planner leads and this one waits."""
        return self.state.rival.yields

    @property
    def rival(self) -> str:
        """Description of the rival planner that leads, or an empty string."""
        return self.state.rival.describe()

    def _commands(self, inputs: Inputs, output: LawOutput) -> list[JointCommand]:
        """Return the tick's six commands; each echoes the stamp of its module's state."""
        s, local, hold = self.state, output.local, self._hold()
        margin, margin_onboard = _rounded_down(local.margins)
        arrays = (
            output.q_ref, output.v_ref, output.tau_ff, output.dtau_ff, output.tau_coupled,
            local.D, local.D_B,
        )  # fmt: skip
        rows = rounded_rows(arrays, _OF_COMMANDS).tolist()
        pairs = [list(zip(row[::2], row[1::2], strict=True)) for row in rows]
        return [
            JointCommand(
                t_ns=inputs.now_ns,
                seq=s.seq,
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
                margin=margin,
                margin_onboard=margin_onboard,
                stiffen=s.support.includes(module),
                state_phase=phase,
                fallen=s.fall.fell_ns > 0,
            )
            for module, state, phase, q_ref, v_ref, tau_ff, dtau_ff, tau_coupled, k_p, k_d in zip(
                MODULES, inputs.states, s.phases.phases, *pairs, strict=True
            )
        ]

    def _toward(self, heat: Toward) -> Toward:
        """Return the direction in which the robot moves on its own; heat takes precedence."""
        return Toward.DOWN if heat is Toward.PERSON and self._sits else heat

    @property
    def _sits(self) -> bool:
        """True while the robot lowers itself, on request or because a supply is low."""
        return self.state.request.sit or self.state.supply.sits

    def _inhibit(self) -> PlannerMode | None:
        """Return the mode that prevents engaging, from the latest results; None if allowed."""
        s = self.state
        if s.rival.yields:
            return PlannerMode.YIELDING
        if s.fall.fell_ns:
            return PlannerMode.FALLEN
        if s.overload.hold:
            return PlannerMode.OVERLOADED
        if s.law.stance.refusal:
            return PlannerMode.MISPLACED
        if s.law.load.blocks:
            return PlannerMode.MISLOADED
        if s.source is _UNCERTIFIED:
            return PlannerMode.UNCERTIFIED
        if s.trips.tripped:
            return PlannerMode.TRIPPED
        return None

    def _hold(self) -> bool:
        """Return True if commands carry `hold`.

        It uses this tick's results, so no uncertified gains reach modules in TRACK.
        """
        return self.state.engagement.hold or self._inhibit() is not None

    def _why(self) -> str:
        """Return messages for the wearer: supply, harness, heat, and why the planner holds."""
        s = self.state
        refusal = (
            s.rival.describe()
            or s.fall.describe()
            or s.law.stance.refusal
            or self._law.load.refusal(s.law.load)
            or s.trips.why
            or self._heat.describe(s.heat)
            or s.unattended.describe()
            or s.guard.why
        )
        parts = self._supply.describe(s.supply), s.trust.describe(), refusal
        return "; ".join(filter(None, parts))

    def status(
        self, now_ns: int, tick_us: float, commands: Sequence[JointCommand] = ()
    ) -> PlannerStatus:
        """Return the inputs, decisions and commands of the last tick."""
        s, output, load = self.state, self._output, self.state.law.load
        seqs = [state.seq if state is not None else -1 for state in s.states]
        ages = [
            now_ns - arrived if state is not None else -1
            for state, arrived in zip(s.states, s.arrived_ns, strict=True)
        ]
        leads = not s.engagement.hold
        carried_n = GRAVITY * (self._payload + load.kg) - (s.heat.lifted or 0.0)
        margin = margin_onboard = 0.0
        p = pdot = p_ref = closure = stance = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        if output is not None:
            vectors = output.p, output.pdot, output.p_ref, output.closure, np.array(output.stance)
            p, pdot, p_ref, closure, stance = map(vector6, rounded_rows(vectors, _OF_STATUS))
            margin, margin_onboard = _rounded_down(output.local.margins)
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
            margin=margin,
            margin_onboard=margin_onboard,
            split=int(output.local.source) if output is not None else int(SplitSource.DIAGONAL),
            ik_iterations=output.ik_iterations if output is not None else 0,
            ik_residual=round(output.ik_residual, 9) if output is not None else 0.0,
            tick_us=tick_us,
            state_seq=(seqs[0], seqs[1], seqs[2], seqs[3], seqs[4], seqs[5]),
            wrench_seq=-1 if s.wrench is None else s.wrench.seq,
            assist_requested_n=s.request.assist_n,
            state_age_ns=(ages[0], ages[1], ages[2], ages[3], ages[4], ages[5]),
            wait_s=0.0 if leads else s.engagement.wait_ns(now_ns) / NS_PER_S,
            attitude_seq=-1 if s.attitude is None else s.attitude.seq,
            slope=output.slope if output is not None else (0.0, 0.0),
            shift_requested=s.request.shift,
            load=(round(load.kg, FORCE), *rounded((load.a, load.b), FORCE)),
            requested_by=s.request.source,
            stance=stance,
            why=self._why(),
            trip=int(s.trips.tripped),
            refused=s.refused,
            sit=s.request.sit,
            heat=int(s.heat.action),
            heat_left_s=s.heat.left_s,
            supply_v=round(s.supply.volts, FORCE),
            wearer=int(s.park.reported(now_ns)) if self._park.enabled else 0,
            park_requested=int(s.request.park),
            carried_n=round(carried_n, FORCE),
            commands=tuple(commands),
        )


def _rounded_down(margins: tuple[float, float]) -> tuple[float, float]:
    """Return margins with four decimals, never larger than they are."""
    service, onboard = margins
    return service * 1e4 // 1.0 / 1e4, onboard * 1e4 // 1.0 / 1e4
