"""Lockstep: the same objects as live, in one process under virtual time (docs/architecture.md).

World, twelve emulated axes, six joint controllers, the harness sensor and the planner step
in a fixed order; messages between them pass a modelled network. No process, clock or bus:
bit-identical from run to run with the same seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import ClassVar

from services.joint.controller import JointController
from services.joint.drive_manager import DriveManager
from services.joint.snapshots import DriveManagerState
from services.joint.tracer import Tracer
from services.planner.checkpoint import Checkpoints
from services.planner.intents import Wish
from services.planner.planner import Planner
from services.planner.snapshots import TickState
from services.simulator.axis_bank import AxisBank
from services.simulator.body import body_of
from services.simulator.fault_injector import FaultInjector
from services.simulator.plant import PlantConfig
from services.simulator.state import restored, taken
from services.simulator.world import World
from shared.bus import topics
from shared.bus.messages import (
    JointEvent,
    Message,
    Mode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
    SimTruth,
)
from shared.bus.topics import Topic
from shared.bus.traces import SimState
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO, Kill, Push, Restart, Scenario
from shared.exceptions import RunError
from shared.network.impairment import Impairment
from shared.robot.joints import MODULE_INDEX, MODULES
from tools.runs.host_clock import HostClock
from tools.runs.network import BASE
from tools.runs.virtual_drive import VirtualDrive
from tools.runs.virtual_harness import VirtualHarness
from tools.runs.virtual_imu import VirtualImu
from tools.runs.virtual_neighbours import near_to
from tools.runs.virtual_network import VirtualNetwork

SETTLE_NS = NS_PER_S
"""The scenario starts this long after all six modules track."""
READY_NS = 20 * NS_PER_S
"""They have so long to do it."""

Record = Callable[[Topic, str, Message], None]
"""Takes what live would be on the bus: topic, module or "", message."""
Watch = Callable[[SimTruth], None]
"""Sees the simulated world at its rate."""


def forget(_topic: Topic, _module: str, _message: Message) -> None:
    """Record nothing."""


class Lockstep:
    """A whole fleet in virtual time; a subclass may be made of other parts."""

    planner_type: ClassVar[type[Planner]] = Planner
    module_type: ClassVar[type[DriveManager]] = DriveManager
    traced: ClassVar[bool] = True
    """What is recorded has all that it takes to execute the services again."""

    def __init__(
        self,
        config: RobotConfig,
        scenario: Scenario,
        network: Impairment | None = None,
        *,
        seed: int = 0,
        record: Record = forget,
        clocks: Mapping[str, HostClock] | None = None,
        plant: PlantConfig | None = None,
    ) -> None:
        """Put the robot on the hoist, drives idle.

        Args:
            config: the robot as its controllers take it to be.
            scenario: what happens; kills and restarts of the planner and, with the onboard
                loop, of joint services.
            network: what every link does by itself, each way; None is 1 ms. What the
                scenario injects comes on top.
            seed: of the network and of the harness sensor's noise.
            record: takes every message.
            clocks: by service, of a host whose clock is not virtual time; not the simulator's.
            plant: how the true robot differs from `config`; None: the realistic default.

        Raises:
            RunError: the scenario kills what has no process here.
        """
        killable = ("planner", *(MODULES if config.joint_service.loop == "onboard" else ()))
        named = [(row.service, row.at) for row in scenario.kill]
        for service, at in named + [(row.service, row.at) for row in scenario.restart]:
            if service not in killable:
                raise RunError(
                    f"{service}@{at:g}: in lockstep only the planner can be killed, and joint "
                    "services with the onboard loop; use `xrl demo` for the others"
                )
        self.config = config
        self.scenario = scenario
        self.plant = plant or PlantConfig()
        self.world = World(body_of(config, self.plant), scenario)
        self._modules = [self.module_type(config, module) for module in MODULES]
        self._traces = self.traced and record is not forget
        self._tracers = [Tracer(module) for module in self._modules]
        self._remembrance = Checkpoints(config.planner.rate_hz)
        self.planner: Planner | None = self.planner_type(config, session=1)
        self.events: list[tuple[str, JointEvent]] = []
        self.estop = False
        """Set it to stop every module."""
        self.now_ns = NS_PER_S
        self._record = record
        self._frozen: set[str] = set()
        """Services that are stopped or dead."""
        self._dead: set[str] = set()
        self._sessions = 1
        self.network = VirtualNetwork(
            network or BASE,
            scenario.inject,
            seed,
            lambda event: record(topics.LINK_EVENT, "", event),
        )
        self._states, self._commands = self.network.states(), self.network.commands()
        self._wrenches = self.network.wrenches()
        clock_of = clocks or {}
        self._clocks = [clock_of.get(module, HostClock()) for module in MODULES]
        self._planner_clock = clock_of.get("planner", HostClock())
        clock = clock_of.get("harness", HostClock())
        self.harness = VirtualHarness(config, self._wrenches, record, seed, clock)
        self._attitudes = self.network.attitudes()
        clock = clock_of.get("imu", HostClock())
        self._imu = VirtualImu(config, self.plant.imu, self._attitudes, record, seed, clock)
        self._cycle_ns = round(NS_PER_S / config.joint_service.rate_hz)
        joint = config.joint_service
        self._state_every = round(joint.rate_hz / joint.state_rate_hz)
        self._step_ns = round(config.simulation.timestep * NS_PER_S)
        self._truth_ns = round(NS_PER_S / config.simulation.truth_rate_hz)
        self._sim_state_ns = round(NS_PER_S / topics.SIM_STATE.rate_hz)
        self._sim_states = 0
        self._tracked_since_ns = 0
        self._todo: list[Kill | Restart | Push] = sorted(
            (*scenario.kill, *scenario.restart, *scenario.push), key=lambda row: row.at
        )
        self._said = 0
        self.bank = AxisBank(
            config.drive,
            encoder_counts_per_turn=config.joint.encoder_counts_per_turn,
            motor_signs=config.motor_signs(),
        )
        self._torque = self.bank.torque
        self._faults = FaultInjector(scenario.fault, self.bank)
        self._drives = [
            VirtualDrive(
                self.bank, index, config.drive, config.module_named(name).motor_signs, self.now_ns
            )
            for index, name in enumerate(MODULES)
        ]

    @property
    def controllers(self) -> list[JointController]:
        """Each module's control law."""
        return [module.controller for module in self._modules]

    def snapshot_of(self, module: str) -> DriveManagerState:
        """Return what a joint service knows now, for `go_on`; it shares what still changes."""
        return self._modules[MODULE_INDEX[module]].snapshot()

    def go_on(
        self,
        state: SimState,
        modules: Mapping[str, DriveManagerState],
        planner: tuple[int, TickState] | None,
    ) -> None:
        """Go on from a moment of another run, before the first step; links are empty then.

        Args:
            state: world and drives.
            modules: what each joint service knew; one that is not named is dead.
            planner: session and what the planner knew; None: it is dead.
        """
        self.now_ns = -(-state.t_ns // self._step_ns) * self._step_ns
        restored(self.world, self.bank, state)
        for index, name in enumerate(MODULES):
            if name in modules:
                self._modules[index].restore(modules[name])
            else:
                self._frozen.add(name)
                self._dead.add(name)
        if planner is None:
            self.planner = None
        else:
            self._sessions = planner[0]
            self.planner = self.planner_type(self.config, planner[0])
            self.planner.restore(planner[1])
        for drive in self._drives:
            drive.heard(self.now_ns)
        self.harness.go_on()
        self._todo = [row for row in self._todo if row.at >= self.world.scenario_s]

    def run(self) -> Iterator[SimTruth]:
        """Run to the scenario's end; yield the truth at its rate.

        Before the scenario begins its time is negative. Ends early if the robot falls
        or never comes to track.
        """
        while self.world.scenario_s < self.scenario.duration:
            while self._todo and self.world.scenario_s >= self._todo[0].at:
                self._act(self._todo.pop(0))
            self.advance()
            if self._traces and self.now_ns % self._sim_state_ns == 0:
                self._sim_states += 1
                state = taken(self.world, self.bank, self.now_ns, self._sim_states)
                self._record(topics.SIM_STATE, "", state)
            if self.now_ns % self._truth_ns == 0:
                truth = self.world.truth(self.now_ns, 1.0, 0.0)
                self._record(topics.SIM_TRUTH, "", truth)
                yield truth
                if truth.scenario_s < 0.0 and (truth.fallen or self.now_ns > READY_NS):
                    return

    def advance(self) -> None:
        """Move virtual time on by one step of the world."""
        now = self.now_ns
        self.network.advance(self.world.scenario_s, now)
        if now % self._cycle_ns == 0:
            for fault in self._faults.advance(self.world.scenario_s):
                self._say(RunEventKind.FAULTED, fault.module, fault.kind)
            self._torque = self.bank.step(self.world.time, *self.world.motor_turns())
            self._cycle_joints(now)
        elif self.bank.regulates:
            self._torque = self.bank.step(self.world.time, *self.world.motor_turns())
        self.harness.advance(self.world, now)
        self._imu.advance(self.world, now)
        if self.planner is not None and "planner" not in self._frozen:
            self._advance_planner(self.planner, now)
        self._begin_when_tracking(now)
        self.world.step(self._torque)
        self.now_ns += self._step_ns

    def _act(self, row: Kill | Restart | Push) -> None:
        """Do what the scenario asks for, and say so."""
        if isinstance(row, Kill):
            self._say(RunEventKind.KILLED, row.service, row.signal)
            self._frozen.add(row.service)
            if row.signal != "STOP":
                self._dead.add(row.service)
        elif isinstance(row, Restart):
            self._say(RunEventKind.RESTARTED, row.service, "")
            self._frozen.discard(row.service)
            if row.service in self._dead:
                self._dead.discard(row.service)
                self._begin_anew(row.service)
        else:
            x, y, z = row.force
            self._say(RunEventKind.PUSHED, "torso", f"{x:g},{y:g},{z:g} N for {row.duration:g} s")

    def _begin_anew(self, service: str) -> None:
        """Start a service that was dead; a module's takes over what its drive carries."""
        if service == "planner":
            self._sessions += 1
            self.planner = self.planner_type(self.config, self._sessions)
            self._remembrance = Checkpoints(self.config.planner.rate_hz)
            return
        index = MODULE_INDEX[service]
        self._modules[index] = self.module_type(self.config, service)
        self._tracers[index] = Tracer(self._modules[index])
        self._drives[index].serve_anew()

    def _say(self, kind: RunEventKind, subject: str, detail: str) -> None:
        self._said += 1
        event = RunEvent(
            t_ns=self.now_ns,
            seq=self._said,
            kind=int(kind),
            subject=subject,
            detail=detail,
            scenario_s=self.world.scenario_s,
        )
        self._record(topics.RUN_EVENT, "", event)

    def _cycle_joints(self, now: int) -> None:
        for index, (name, module) in enumerate(zip(MODULES, self._modules, strict=True)):
            if name in self._frozen:
                continue
            drive, host_ns = self._drives[index], self._clocks[index].read(now)
            given = (host_ns, drive.read(host_ns), self._commands[index].take(now), self.estop)
            near = near_to(index, now, self._modules, self._clocks, self._dead)
            step = module.step(*given, near)
            drive.carry_out(step, onboard=module.onboard)
            if step.event is not None:
                self.events.append((name, step.event))
                self._record(topics.JOINT_EVENT, name, step.event)
            if module.controller.cycle % self._state_every == 0:
                state = module.controller.state(host_ns)
                self._states[index].put(now, state)
                self._record(topics.JOINT_STATE, name, state)
            if self._traces:
                trace = self._tracers[index].after(*given, step, near)
                if trace is not None:
                    self._record(topics.JOINT_TRACE, name, trace)

    def _advance_planner(self, planner: Planner, now: int) -> None:
        """Hand over what has arrived, and tick as the live loop does."""
        host_ns = self._planner_clock.read(now)
        for index, link in enumerate(self._states):
            state = link.take(now)
            if state is not None:
                planner.receive_state(index, state, host_ns)
        if not planner.is_due(host_ns):
            return
        wrench = self._wrenches.take(now)
        if wrench is not None:
            planner.receive_wrench(wrench, host_ns)
        attitude = self._attitudes.take(now)
        if attitude is not None:
            planner.receive_attitude(attitude, host_ns)
        wanted = self.world.lead()
        planner.receive_wish(Wish(wanted.assist, wanted.shift, SCENARIO))
        for index, command in enumerate(planner.tick(host_ns)):
            self._commands[index].put(now, command)
            self._record(topics.JOINT_COMMAND, MODULES[index], command)
        status: PlannerStatus = planner.status(host_ns, 0.0)
        self._record(topics.PLANNER_STATUS, "", status)
        memory = self._remembrance.after(planner, host_ns) if self._traces else None
        if memory is not None:
            self._record(topics.PLANNER_CHECKPOINT, "", memory)

    def _begin_when_tracking(self, now: int) -> None:
        if self.world.scenario_s >= 0.0:
            return
        modes = [module.controller.failsafe.mode for module in self._modules]
        if Mode.DISARMED not in modes:
            self.world.release_hoist()
        if self.world.hoist > 0.0 or any(mode is not Mode.TRACK for mode in modes):
            self._tracked_since_ns = now
        elif now - self._tracked_since_ns >= SETTLE_NS:
            self.world.start()
            self._say(RunEventKind.STARTED, self.scenario.name, "")
