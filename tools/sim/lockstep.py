"""Lockstep: deterministic simulation in virtual time, in one process (docs/architecture.md).

World, twelve emulated axes, six joint services, harness, IMU and planner step in a fixed order.
Messages between them pass through a modelled network. The services are those of a live fleet,
without processes, clocks or a bus, so two runs with the same seed are equal to the last bit.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import ClassVar, Final

import msgspec

from services.joint.controller import ControllerState
from services.joint.drive_manager import DriveManager, DriveManagerState
from services.planner.controller import Controller
from services.planner.intents import OperatorRequest
from services.planner.planner import Planner, PlannerState
from services.simulator.physics.plant import PlantConfig
from services.simulator.physics.plant import to_toml as plant_to_toml
from services.simulator.robot import SimulatedRobot, axes_by_bus
from shared.bus import topics
from shared.bus.messages import HandLead, JointEvent, Message, Mode, RunEvent, RunEventKind
from shared.bus.topics import Topic
from shared.bus.traces import SimState, SimTruth
from shared.can.sensor_frames import ImuAssembler, SampleAssembler
from shared.clock import NS_PER_S
from shared.config.files import to_toml
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO, Keyframe, Kill, Push, Restart, Scenario
from shared.exceptions import RunError
from shared.joints import MODULE_INDEX, MODULES
from shared.state import copied
from tools.logs.hand_path import HandRow
from tools.sim.network import BASE, VirtualNetwork
from tools.sim.virtual_drive import VirtualBus
from tools.sim.virtual_services import (
    HostClock,
    Record,
    SharedMemory,
    VirtualCan,
    VirtualHarness,
    VirtualImu,
    VirtualJoint,
    VirtualPlanner,
    VirtualTime,
)

SETTLE_NS = NS_PER_S
"""Time from the moment when all six modules track to the scenario's start, ns."""
READY_NS = 20 * NS_PER_S
"""Virtual time by which the scenario must have started, ns: 19 s after the start of a run."""

Happening = Kill | Restart | Push | HandRow
"""Action of a scenario, or of a person who watches the run."""
Watch = Callable[[SimTruth], None]
"""Called with each truth of the simulated world that a run yields."""


def forget(_topic: Topic, _module: str, _message: Message) -> None:
    """Record nothing."""


class FleetMoment(msgspec.Struct, frozen=True):
    """State of the simulated world, the joint services and the planner at one moment of a run."""

    state: SimState
    """World and drives."""
    modules: Mapping[str, DriveManagerState]
    """State of each joint service by name; a missing service is dead."""
    planner: tuple[int, PlannerState] | None
    """Session and state of the planner; None if it is dead."""


class _Progress(msgspec.Struct):
    """Progress of the run."""

    todo: list[Happening]
    """Remaining actions, in order."""
    tracked_since_ns: int = 0
    sim_states: int = 0
    led: int = 0
    run_events: int = 0


class Lockstep:
    """A whole fleet in virtual time; a subclass may use other planners or joint services.

    Attributes:
        buses: the drives' CAN buses by name.
        joints: the six joint services, in the order of `MODULES`.
        events: each change of mode, with its module.
        time: virtual time.
    """

    planner_type: ClassVar[type[Planner]] = Planner
    module_type: ClassVar[type[DriveManager]] = DriveManager

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
        planner_beside: bool = False,
        traced: bool = False,
    ) -> None:
        """Put the robot on the hoist, drives idle.

        Args:
            config: robot file of the controllers.
            scenario: course of the run; it may kill and restart the planner and, with the onboard
                loop, joint services.
            network: impairment of every link, each way; None is a delay of 1 ms. The scenario's
                impairments are added.
            seed: seed of the network and of the sensors' noise.
            record: called with every message.
            clocks: clocks of hosts that differ from virtual time, by service.
            plant: how the true robot differs from `config`; None for the realistic default.
            hand: recorded path of the hand, which replaces the scenario's.
            controller: makes a custom controller for each planner.
            planner_beside: True if the planner runs on the joint services' host, which detects its
                end at once. Otherwise only the age of its commands reveals the end, later.
            traced: True to also record the inputs for re-execution of the services.

        Raises:
            RunError: the scenario kills or restarts a service that lockstep cannot kill.
        """
        self._check_kills(config, scenario)
        self.config, self.scenario = config, scenario
        self.plant = plant or PlantConfig()
        self.events: list[tuple[str, JointEvent]] = []
        self.time = time = VirtualTime(NS_PER_S)
        self._record, self._traced = record, traced
        self.network = network_ = VirtualNetwork(
            network or BASE,
            scenario.inject,
            seed,
            lambda event: record(topics.LINK_EVENT, "", event),
        )
        clock_of = {name: HostClock() for name in ("planner", "harness", "imu", *MODULES)}
        clock_of |= clocks or {}
        cells, frames = VirtualCan(SampleAssembler()), VirtualCan(ImuAssembler())
        self._robot = robot = SimulatedRobot(
            config, self.plant, scenario, cells=cells,
            imu=frames if config.imu.fitted else None, seed=seed,
        )  # fmt: skip
        self.world, self.bank = robot.world, robot.bank
        self.harness = VirtualHarness(
            config, robot, cells, network_, record, time=time, clock=clock_of["harness"]
        )
        self._imu = VirtualImu(
            config, robot, frames, network_, record, time=time, clock=clock_of["imu"]
        )
        self._memory = SharedMemory()

        def new_planner(session: int) -> Planner:
            if controller is None:
                return self.planner_type(config, session)
            return Planner(config, session, controller())

        self._planner = VirtualPlanner(
            config, new_planner, self._request, network_, record,
            time=time, clock=clock_of["planner"], traced=traced,
            beside=self._memory if planner_beside else None,
        )  # fmt: skip
        self.buses = {
            name: VirtualBus(self.bank, tuple(nodes.values()))
            for name, nodes in axes_by_bus(config).items()
        }
        self.joints = [
            VirtualJoint(
                config, index, functools.partial(self.module_type, config, name), self.bank,
                self.buses[config.module_named(name).bus], self._memory, network_, record,
                time=time, clock=clock_of[name], traced=traced,
            )
            for index, name in enumerate(MODULES)
        ]  # fmt: skip
        happens: list[Happening] = [*scenario.kill, *scenario.restart, *scenario.push, *hand]
        self._progress = _Progress(sorted(happens, key=lambda row: row.at))

    def _request(self) -> OperatorRequest:
        wanted = self.world.lead()
        return OperatorRequest(wanted.assist, wanted.shift, SCENARIO)

    @property
    def now_ns(self) -> int:
        """Virtual time."""
        return self.time.now_ns

    @property
    def estop(self) -> bool:
        """The emergency stop; set it to stop every module."""
        return self._memory.estop

    @estop.setter
    def estop(self, estop: bool) -> None:
        self._memory.estop = estop

    @property
    def planner(self) -> Planner | None:
        """The planner; set it to None for a robot without one."""
        return self._planner.planner

    @planner.setter
    def planner(self, planner: Planner | None) -> None:
        self._planner.planner = planner

    @property
    def controllers(self) -> list[ControllerState]:
        """State of each module's control law."""
        return [joint.manager.state.controller for joint in self.joints]

    def moment(self) -> FleetMoment:
        """Return the present state of world and services, for `resume`."""
        planner = self.planner
        return FleetMoment(
            self._robot.read_state(self.now_ns, 0),
            {joint.name: copied(joint.manager.state) for joint in self.joints},
            None if planner is None else (planner.session, copied(planner.state)),
        )

    def resume(self, moment: FleetMoment) -> None:
        """Continue from a moment of another run; only before the first step. Links start empty."""
        state, modules = moment.state, moment.modules
        step_ns = self._robot.every.step
        self.time.now_ns = -(-state.t_ns // step_ns) * step_ns
        self._robot.write_state(state)
        for joint in self.joints:
            joint.resume(modules.get(joint.name))
        self._planner.resume(moment.planner)
        self.harness.assume_tared()
        self._progress.todo = [
            row for row in self._progress.todo if row.at >= self.world.scenario_s
        ]

    def run(self) -> Iterator[SimTruth]:
        """Run to the scenario's end; yield the truth at the rate of its topic.

        Scenario time is negative before the scenario starts. The run ends early if the robot falls
        before the start, or if the scenario has not started by `READY_NS`.
        """
        every = self._robot.every
        while self.world.scenario_s < self.scenario.duration:
            while self._progress.todo and self.world.scenario_s >= self._progress.todo[0].at:
                self.act(self._progress.todo.pop(0))
            self.advance()
            if self._traced and self.now_ns % every.state == 0:
                self._progress.sim_states += 1
                state = self._robot.read_state(self.now_ns, self._progress.sim_states)
                self._record(topics.SIM_STATE, "", state)
            if self.now_ns % every.truth == 0:
                truth = self.world.truth(self.now_ns, 1.0, 0.0)
                self._record(topics.SIM_TRUTH, "", truth)
                yield truth
                if truth.scenario_s < 0.0 and (truth.fallen or self.now_ns > READY_NS):
                    return

    def advance(self) -> None:
        """Advance virtual time by one step of the world."""
        robot, now = self._robot, self.now_ns
        self.network.advance(self.world.scenario_s, now)
        if now % robot.every.encoders == 0:
            for fault in robot.begin_faults():
                self._put_event(RunEventKind.FAULTED, fault.module, fault.kind)
            for bus in self.buses.values():
                bus.advance(now)
            robot.step_drives()
            for joint in self.joints:
                if not joint.frozen and (event := joint.cycle().event) is not None:
                    self.events.append((joint.name, event))
        elif self.bank.regulates:
            robot.step_drives()
        self.harness.advance()
        self._imu.advance()
        self._planner.advance()
        self._start_when_tracking(now)
        robot.step_world()
        self.time.now_ns += robot.every.step

    def lead(self, hand: HandLead) -> None:
        """Lead the hand in place of the scenario, and record it."""
        self._progress.led += 1
        hand = msgspec.structs.replace(hand, t_ns=self.now_ns, seq=self._progress.led)
        self.world.take_hand(hand)
        self._record(topics.OPERATOR_HAND, "", hand)

    def act(self, row: Happening) -> None:
        """Execute an action of the scenario, or of a person who watches, and record it."""
        if isinstance(row, HandRow):
            self.lead(row.hand)
            return
        if isinstance(row, Push):
            x, y, z = row.force
            detail = f"{x:g},{y:g},{z:g} N for {row.duration:g} s"
            self._put_event(RunEventKind.PUSHED, "torso", detail)
            return
        service = (
            self._planner if row.service == "planner" else self.joints[MODULE_INDEX[row.service]]
        )
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
            self._progress.tracked_since_ns = now
        elif now - self._progress.tracked_since_ns >= SETTLE_NS:
            self.world.start()
            self._put_event(RunEventKind.STARTED, self.scenario.name, "")

    def _put_event(self, kind: RunEventKind, subject: str, detail: str) -> None:
        self._progress.run_events += 1
        event = RunEvent(
            t_ns=self.now_ns,
            seq=self._progress.run_events,
            kind=int(kind),
            subject=subject,
            detail=detail,
            scenario_s=self.world.scenario_s,
        )
        self._record(topics.RUN_EVENT, "", event)

    @staticmethod
    def _check_kills(config: RobotConfig, scenario: Scenario) -> None:
        killable = ("planner", *(MODULES if config.joint_service.loop == "onboard" else ()))
        named = [(row.service, row.at) for row in scenario.kill]
        for service, at in named + [(row.service, row.at) for row in scenario.restart]:
            if service not in killable:
                raise RunError(
                    f"{service}@{at:g}: lockstep can kill and restart only the planner and, with "
                    "the onboard loop, joint services; use `xrl demo` for the others"
                )


NOTHING_HAPPENS: Final = Scenario(
    name="stand", about="nothing happens", duration=1.0, keyframe=(Keyframe(at=0.0, height=1.188),)
)


def begin_standing(fleet: Lockstep) -> bool:
    """Start a new fleet with the robot standing, all six modules in TRACK, as its scenario begins.

    Standing up takes 3.6 s of each run. So in each process a robot stands up once per plant, and
    its runs continue from there. Standing up itself is tested by
    `tests/lockstep/test_dead_services.py` and by the sweeps over drawn plants, which start on the
    hoist. Returns False if this robot's scenario never begins on this plant; the fleet then starts
    on the hoist.
    """
    start = standing(fleet.config, fleet.plant)
    if start is not None:
        fleet.resume(start)
    return start is not None


def standing(robot: RobotConfig, plant: PlantConfig) -> FleetMoment | None:
    """Return the moment at which a scenario begins over `BASE` links; None if it never does."""
    schedule = robot.gain_schedule
    key = (to_toml(robot), plant_to_toml(plant), schedule.digest if schedule else "")
    if key not in _known:
        _known[key] = _stood_up(robot, plant)
    return _known[key]


_known: dict[tuple[str, str, str], FleetMoment | None] = {}


def _stood_up(robot: RobotConfig, plant: PlantConfig) -> FleetMoment | None:
    fleet = Lockstep(robot, NOTHING_HAPPENS, BASE, plant=plant)
    if not any(row.scenario_s >= 0.0 for row in fleet.run()) or fleet.planner is None:
        return None
    return fleet.moment()
