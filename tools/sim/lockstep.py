"""Lockstep: deterministic simulation in virtual time, in one process (docs/architecture.md).

World, twelve emulated axes, six joint services, harness, IMU and planner step in a fixed order.
Messages between them pass a modelled network. They are the objects of the live services, without
process, clock or bus: two runs with one seed are equal to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import ClassVar

import msgspec

from services.joint.controller import JointController
from services.joint.drive_manager import DriveManager
from services.joint.snapshots import DriveManagerState
from services.planner.controller import Controller
from services.planner.intents import OperatorRequest
from services.planner.planner import Planner
from services.planner.snapshots import TickState
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fault_injector import FaultInjector
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import PlantConfig
from services.simulator.physics.world import World
from services.simulator.state import read_state, write_state
from shared.bus import topics
from shared.bus.messages import (
    HandLead,
    JointEvent,
    Message,
    Mode,
    RunEvent,
    RunEventKind,
    SimTruth,
)
from shared.bus.topics import Topic
from shared.bus.traces import SimState
from shared.clock import NS_PER_S
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO, Kill, Push, Restart, Scenario
from shared.exceptions import RunError
from shared.joints import MODULE_INDEX, MODULES
from tools.logs.hand_path import HandRow
from tools.sim.host_clock import HostClock
from tools.sim.network import BASE
from tools.sim.virtual_drive import VirtualDrive
from tools.sim.virtual_harness import VirtualHarness
from tools.sim.virtual_imu import VirtualImu
from tools.sim.virtual_joint import NeighbourRows, VirtualJoint
from tools.sim.virtual_network import VirtualNetwork
from tools.sim.virtual_planner import VirtualPlanner

SETTLE_NS = NS_PER_S
"""The scenario starts this long after all six modules track, ns."""
READY_NS = 20 * NS_PER_S
"""Virtual time by which the scenario must have started, ns. It starts at 1 s: 19 s of a run."""

Record = Callable[[Topic, str, Message], None]
"""Takes what live would be on the bus: topic, module or "", message."""
Watch = Callable[[SimTruth], None]
"""Sees the simulated world at its rate."""


def forget(_topic: Topic, _module: str, _message: Message) -> None:
    """Record nothing."""


class FleetMoment(msgspec.Struct, frozen=True):
    """What the simulated world and each service are at one moment of a run."""

    state: SimState
    """World and drives."""
    modules: Mapping[str, DriveManagerState]
    """State of each joint service; one that is not named is dead."""
    planner: tuple[int, TickState] | None
    """Session and state of the planner; None: it is dead."""


class Lockstep:
    """A whole fleet in virtual time; a subclass may use other planners or joint services.

    Attributes:
        joints: the six joint services, in the order of `MODULES`.
        events: each change of mode, with its module.
        estop: set it to stop every module.
        now_ns: virtual time.
    """

    planner_type: ClassVar[type[Planner]] = Planner
    module_type: ClassVar[type[DriveManager]] = DriveManager
    traced: ClassVar[bool] = True
    """Record all that re-execution of the services needs."""

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
        hand: Sequence[HandRow] = (),
        controller: Callable[[], Controller] | None = None,
    ) -> None:
        """Put the robot on the hoist, drives idle.

        Args:
            config: the robot as its controllers know it.
            scenario: what happens; it may kill and restart the planner and, with the onboard loop,
                joint services.
            network: of every link, each way; None is 1 ms. The scenario's impairments come on top.
            seed: of the network and of the harness sensor's noise.
            record: takes every message.
            clocks: by service, of a host whose clock is not virtual time; not the simulator's.
            plant: how the true robot differs from `config`; None: the realistic default.
            hand: how somebody leads the hand in place of the scenario.
            controller: makes a controller of somebody's own for each planner.

        Raises:
            RunError: the scenario kills a service that has no process here.
        """
        self._check_kills(config, scenario)
        self.config, self.scenario = config, scenario
        self.plant = plant or PlantConfig()
        self.world = World(body_of(config, self.plant), scenario)
        self.events: list[tuple[str, JointEvent]] = []
        self.estop = False
        self.now_ns = NS_PER_S
        self._record = record
        self._traces = self.traced and record is not forget
        self._controller = controller
        self.network = VirtualNetwork(
            network or BASE,
            scenario.inject,
            seed,
            lambda event: record(topics.LINK_EVENT, "", event),
        )
        clock_of = {name: HostClock() for name in ("planner", "harness", "imu", *MODULES)}
        clock_of |= clocks or {}
        self.harness = VirtualHarness(
            config, self.network.wrenches(), record, seed, clock_of["harness"]
        )
        self._imu = VirtualImu(
            config, self.plant.imu, self.network.attitudes(), record, seed, clock_of["imu"]
        )
        self._planner = VirtualPlanner(
            self._new_planner,
            self.network,
            record,
            rate_hz=config.planner.rate_hz,
            clock=clock_of["planner"],
            traced=self._traces,
        )
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
        self.joints = [self._joint(index, clock_of[name]) for index, name in enumerate(MODULES)]
        self._cycle_ns = round(NS_PER_S / config.joint_service.rate_hz)
        self._step_ns = round(config.simulation.timestep * NS_PER_S)
        self._truth_ns = round(NS_PER_S / config.simulation.truth_rate_hz)
        self._sim_state_ns = round(NS_PER_S / topics.SIM_STATE.rate_hz)
        self._sim_states = 0
        self._tracked_since_ns = 0
        self._todo: list[Kill | Restart | Push | HandRow] = sorted(
            (*scenario.kill, *scenario.restart, *scenario.push, *hand), key=lambda row: row.at
        )
        self._led = 0
        self._run_events = 0

    @property
    def planner(self) -> Planner | None:
        """The planner; set it to None for a robot without one."""
        return self._planner.planner

    @planner.setter
    def planner(self, planner: Planner | None) -> None:
        self._planner.planner = planner

    @property
    def controllers(self) -> list[JointController]:
        """Each module's control law."""
        return [joint.manager.controller for joint in self.joints]

    def moment(self) -> FleetMoment:
        """Return what world and services are now, for `resume`; it shares what still changes."""
        planner = self.planner
        return FleetMoment(
            read_state(self.world, self.bank, self.now_ns, 0),
            {joint.name: joint.manager.snapshot() for joint in self.joints},
            None if planner is None else (planner.session, planner.snapshot()),
        )

    def resume(self, moment: FleetMoment) -> None:
        """Continue from a moment of another run, before the first step; links are empty then."""
        state, modules = moment.state, moment.modules
        self.now_ns = -(-state.t_ns // self._step_ns) * self._step_ns
        write_state(self.world, self.bank, state)
        for joint in self.joints:
            if joint.name in modules:
                joint.manager.restore(modules[joint.name])
            else:
                joint.kill(for_good=True)
        self._planner.resume(moment.planner)
        for drive in self._drives:
            drive.assume_heard(self.now_ns)
        self.harness.assume_tared()
        self._todo = [row for row in self._todo if row.at >= self.world.scenario_s]

    def run(self) -> Iterator[SimTruth]:
        """Run to the scenario's end; yield the truth at its rate.

        Before the scenario starts its time is negative. Ends early if by then the robot has fallen,
        or if the scenario has not started when virtual time is past `READY_NS`.
        """
        while self.world.scenario_s < self.scenario.duration:
            while self._todo and self.world.scenario_s >= self._todo[0].at:
                self.act(self._todo.pop(0))
            self.advance()
            if self._traces and self.now_ns % self._sim_state_ns == 0:
                self._sim_states += 1
                state = read_state(self.world, self.bank, self.now_ns, self._sim_states)
                self._record(topics.SIM_STATE, "", state)
            if self.now_ns % self._truth_ns == 0:
                truth = self.world.truth(self.now_ns, 1.0, 0.0)
                self._record(topics.SIM_TRUTH, "", truth)
                yield truth
                if truth.scenario_s < 0.0 and (truth.fallen or self.now_ns > READY_NS):
                    return

    def advance(self) -> None:
        """Advance virtual time by one step of the world."""
        now = self.now_ns
        self.network.advance(self.world.scenario_s, now)
        if now % self._cycle_ns == 0:
            for fault in self._faults.advance(self.world.scenario_s):
                self._put_event(RunEventKind.FAULTED, fault.module, fault.kind)
            self._torque = self.bank.step(self.world.time, *self.world.motor_turns())
            self._cycle_joints(now)
        elif self.bank.regulates:
            self._torque = self.bank.step(self.world.time, *self.world.motor_turns())
        self.harness.advance(self.world, now)
        self._imu.advance(self.world, now)
        self._planner.advance(now, self._request)
        self._start_when_tracking(now)
        self.world.step(self._torque)
        self.now_ns += self._step_ns

    def _new_planner(self, session: int) -> Planner:
        if self._controller is None:
            return self.planner_type(self.config, session)
        return Planner(self.config, session, self._controller())

    def _request(self) -> OperatorRequest:
        wanted = self.world.lead()
        return OperatorRequest(wanted.assist, wanted.shift, SCENARIO)

    def _cycle_joints(self, now: int) -> None:
        rows = NeighbourRows(self.joints, now)
        for index, joint in enumerate(self.joints):
            if joint.frozen:
                continue
            event = joint.cycle(now, estop=self.estop, near=rows.view(index))
            rows.write(index)
            if event is not None:
                self.events.append((joint.name, event))

    def lead(self, hand: HandLead) -> None:
        """Let somebody lead the hand in place of the scenario, and record it."""
        self._led += 1
        hand = msgspec.structs.replace(hand, t_ns=self.now_ns, seq=self._led)
        self.world.take_hand(hand)
        self._record(topics.OPERATOR_HAND, "", hand)

    def act(self, row: Kill | Restart | Push | HandRow) -> None:
        """Carry out a row of the scenario, or of somebody who looks on, and record it."""
        if isinstance(row, HandRow):
            self.lead(row.hand)
            return
        if isinstance(row, Push):
            x, y, z = row.force
            detail = f"{x:g},{y:g},{z:g} N for {row.duration:g} s"
            self._put_event(RunEventKind.PUSHED, "torso", detail)
            return
        service = self._planner if row.service == "planner" else self._joint_named(row.service)
        if isinstance(row, Kill):
            self._put_event(RunEventKind.KILLED, row.service, row.signal)
            service.kill(for_good=row.signal != "STOP")
        else:
            self._put_event(RunEventKind.RESTARTED, row.service, "")
            service.restart()

    def _start_when_tracking(self, now: int) -> None:
        if self.world.scenario_s >= 0.0:
            return
        modes = [controller.failsafe.mode for controller in self.controllers]
        if Mode.DISARMED not in modes:
            self.world.release_hoist()
        if self.world.hoist > 0.0 or any(mode is not Mode.TRACK for mode in modes):
            self._tracked_since_ns = now
        elif now - self._tracked_since_ns >= SETTLE_NS:
            self.world.start()
            self._put_event(RunEventKind.STARTED, self.scenario.name, "")

    def _put_event(self, kind: RunEventKind, subject: str, detail: str) -> None:
        self._run_events += 1
        event = RunEvent(
            t_ns=self.now_ns,
            seq=self._run_events,
            kind=int(kind),
            subject=subject,
            detail=detail,
            scenario_s=self.world.scenario_s,
        )
        self._record(topics.RUN_EVENT, "", event)

    def _joint(self, index: int, clock: HostClock) -> VirtualJoint:
        name = MODULES[index]
        return VirtualJoint(
            name,
            lambda: self.module_type(self.config, name),
            self._drives[index],
            self.network.commands()[index],
            self.network.states()[index],
            self._record,
            clock=clock,
            traced=self._traces,
        )

    def _joint_named(self, name: str) -> VirtualJoint:
        return self.joints[MODULE_INDEX[name]]

    @staticmethod
    def _check_kills(config: RobotConfig, scenario: Scenario) -> None:
        killable = ("planner", *(MODULES if config.joint_service.loop == "onboard" else ()))
        named = [(row.service, row.at) for row in scenario.kill]
        for service, at in named + [(row.service, row.at) for row in scenario.restart]:
            if service not in killable:
                raise RunError(
                    f"{service}@{at:g}: in lockstep only the planner can be killed, and "
                    "joint services with the onboard loop; use `xrl demo` for the others"
                )
