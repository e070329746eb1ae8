"""The services in virtual time: their own loops, over modelled links and clocks.

No service is reimplemented here; this module adds only how a service is killed and restarted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from services.harness.filter import WrenchFilter, tared_state
from services.harness.loop import HarnessLoop
from services.imu.attitude import AttitudeLaw
from services.imu.loop import ImuLoop
from services.joint.controller import row_of
from services.joint.drive_manager import DriveAction, DriveManager, DriveManagerState
from services.joint.drivers.wired_drive import MotorFrame, WiredDrive
from services.joint.loop import JointLoop, JointPorts
from services.joint.neighbours import NeighbourRow, NeighbourView, view_of
from services.planner.intents import OperatorRequest
from services.planner.loop import PlannerLoop, PlannerPorts
from services.planner.planner import Planner, PlannerState
from services.simulator.drives.axis_bank import AxisBank
from services.simulator.robot import SimulatedRobot
from shared.bus import topics
from shared.bus.messages import Estop, Message, TareRequest, Vector6
from shared.bus.topics import Topic
from shared.bus.traces import PlannerCheckpoint
from shared.can.sensor_frames import FrameGroup, ImuSample
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.links import ATTITUDES, WRENCHES
from shared.state import copied
from tools.sim.network import VirtualLink, VirtualNetwork
from tools.sim.virtual_drive import VirtualBus, VirtualDrive

M = TypeVar("M", bound=Message)

Record = Callable[[Topic, str, Message], None]
"""Called with each message that would be on a live bus: topic, module or "", message."""


class HostClock:
    """The monotonic clock of one host.

    It does not step with the time of day, but differs between hosts, so an age is measured on one
    clock only (docs/architecture.md#age-rule).
    """

    def __init__(self, offset_ns: int = 0, drift_ppm: float = 0.0) -> None:
        """Start ahead of virtual time by `offset_ns`, and gain `drift_ppm` millionths."""
        self.offset_ns = offset_ns
        self.drift_ppm = drift_ppm

    def read(self, now_ns: int) -> int:
        """Return the host's time at a virtual time, ns."""
        drift_ns = round(now_ns * self.drift_ppm * 1e-6) if self.drift_ppm else 0
        return now_ns + self.offset_ns + drift_ns

    def step(self, by_ns: int) -> None:
        """Step the clock, which never happens to a real monotonic clock."""
        self.offset_ns += by_ns


class VirtualTime:
    """Virtual time of a run, which its processes read only through their host's clock."""

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns

    def on(self, clock: HostClock) -> Callable[[], int]:
        """Return a function that reads a host's clock."""
        return lambda: clock.read(self.now_ns)


class _LinkInbox(Generic[M]):
    """The receiving end of a link: an `Inbox`."""

    refused = 0

    def __init__(self, link: VirtualLink[M], time: VirtualTime) -> None:
        self._link, self._time = link, time

    def take(self) -> M | None:
        """Return the newest message since the last call, or None."""
        return self._link.take(self._time.now_ns)


class _RecordOutbox(Generic[M]):
    """An `Outbox` that records messages and, with a `link`, sends them."""

    def __init__(
        self,
        record: Record,
        topic: Topic,
        module: str = "",
        link: VirtualLink[M] | None = None,
        time: VirtualTime | None = None,
    ) -> None:
        self._record, self._topic, self._module = record, topic, module
        self._link, self._time = link, time

    def put(self, message: M, /) -> bool:
        if self._link is not None and self._time is not None:
            self._link.put(self._time.now_ns, message)
        self._record(self._topic, self._module, message)
        return True


S = TypeVar("S")


class SharedMemory:
    """Rows that a host's six joint services share, and the emergency stop.

    Attributes:
        estop: set it to stop every module.
        rows: last row of each service, in virtual time.
        planner: session of the planner's process on this host; 0 without one.
        ended: session of the planner that ended last.
    """

    def __init__(self) -> None:
        self.estop = False
        self.rows: list[NeighbourRow | None] = [None] * len(MODULES)
        self.planner = self.ended = 0

    def announce(self, session: int) -> None:
        """Set the session of the planner on this host."""
        self.planner = session


class _Neighbourhood:
    """One module's access to the shared memory: other modules, stops, the planner's end."""

    def __init__(
        self, memory: SharedMemory, index: int, time: VirtualTime, clock: Callable[[], int]
    ) -> None:
        self._memory, self._index = memory, index
        self._time, self._clock = time, clock
        self._ended = 0

    def ended(self) -> int:
        """Return the session of a planner that has ended since the last call, else 0."""
        if self._ended == self._memory.ended:
            return 0
        self._ended = self._memory.ended
        return self._ended

    def view(self, _host_ns: int) -> NeighbourView:
        """Return this module's view of the others; all rows are in virtual time."""
        return view_of(MODULES[self._index], self._memory.rows, self._time.now_ns)

    def write(self, row: NeighbourRow, *, is_dead: bool = False) -> None:
        """Write this module's row; the stamp of a dead module without a sample is not 0."""
        offset_ns = self._clock() - self._time.now_ns
        if not row.t_ns:
            row = row._replace(t_ns=int(is_dead))
        elif offset_ns:
            row = row._replace(t_ns=row.t_ns - offset_ns)
        self._memory.rows[self._index] = row

    def take(self) -> Estop | None:
        """Return the emergency stop while it is set."""
        return Estop(t_ns=0, seq=0, source="lockstep") if self._memory.estop else None


class VirtualJoint:
    """A joint service.

    Attributes:
        frozen: True if stopped or dead: it runs no cycle, and its drive keeps its last target.
    """

    def __init__(
        self,
        config: RobotConfig,
        index: int,
        make: Callable[[], DriveManager],
        bank: AxisBank,
        bus: VirtualBus,
        memory: SharedMemory,
        network: VirtualNetwork,
        record: Record,
        *,
        time: VirtualTime,
        clock: HostClock,
        traced: bool,
    ) -> None:
        """Start the service of module `index`; `make` is called now and at each restart."""
        self.name = name = MODULES[index]
        self.frozen = self._is_dead = False
        self._config, self._make, self._clock = config, make, time.on(clock)
        self.drive = VirtualDrive(
            bank,
            index,
            config.drive,
            self._clock,
            bus=bus,
            counts_per_turn=config.joint.encoder_counts_per_turn,
            tells_heat=config.simulation.can_dialect == "0.6",
        )
        frame = MotorFrame(config.drive.zero_mark_turns, config.module_named(name).motor_signs)
        self._wired = WiredDrive(self.drive, frame)
        self._place = _Neighbourhood(memory, index, time, self._clock)
        links = network.links
        self._ports = JointPorts(
            commands=_LinkInbox(links[f"planner->{name}"], time),
            estops=self._place,
            states=_RecordOutbox(record, topics.JOINT_STATE, name, links[f"{name}->planner"], time),
            events=_RecordOutbox(record, topics.JOINT_EVENT, name),
            traces=_RecordOutbox(record, topics.JOINT_TRACE, name) if traced else None,
            planner=self._place,
        )
        self._start(make())

    @property
    def manager(self) -> DriveManager:
        """The service's drive manager; a new one acts from the next cycle on."""
        return self._loop.module

    @manager.setter
    def manager(self, manager: DriveManager) -> None:
        self._start(manager)

    def _start(self, manager: DriveManager) -> None:
        self._loop = JointLoop(
            self._config,
            manager,
            self._wired,
            self._ports,
            neighbours=self._place,
            clock=self._clock,
        )
        self._write_row()

    def _write_row(self, *, is_dead: bool = False) -> None:
        self._place.write(row_of(self.manager.state.controller, self._clock()), is_dead=is_dead)

    def cycle(self) -> DriveAction:
        """Run one cycle."""
        return self._loop.cycle()

    def kill(self, *, for_good: bool) -> None:
        """Freeze the service; with `for_good` it is dead, and a restart replaces it."""
        self.frozen, self._is_dead = True, self._is_dead or for_good
        self._write_row(is_dead=self._is_dead)

    def restart(self) -> None:
        """Continue a frozen service, or replace a dead one, which takes over its armed drive."""
        self.frozen = False
        if self._is_dead:
            self._is_dead = False
            self._start(self._make())
            self.drive.start_service()

    def resume(self, state: DriveManagerState | None) -> None:
        """Continue from another run's service; None if it is dead."""
        if state is None:
            self.kill(for_good=True)
        else:
            self.manager.state = copied(state)
            self._write_row()
        self.drive.assume_heard()


class VirtualPlanner:
    """The planner's process.

    Attributes:
        loop: the planner's loop; None without a planner.
        frozen: True if stopped or dead.
    """

    def __init__(
        self,
        config: RobotConfig,
        make: Callable[[int], Planner],
        request: Callable[[], OperatorRequest],
        network: VirtualNetwork,
        record: Record,
        *,
        time: VirtualTime,
        clock: HostClock,
        traced: bool,
        beside: SharedMemory | None,
    ) -> None:
        """Start the service; `make` is called with a session, now and at each restart.

        `beside` is the memory of the joint services' host if the planner runs on that host.
        """
        self.frozen = self._is_dead = False
        self._config, self._make, self._clock = config, make, time.on(clock)
        self._memory = beside
        links = network.links
        checkpoints = _RecordOutbox[PlannerCheckpoint](record, topics.PLANNER_CHECKPOINT)
        self._ports = PlannerPorts(
            states=[_LinkInbox(links[f"{name}->planner"], time) for name in MODULES],
            wrench=_LinkInbox(links[WRENCHES], time),
            attitude=_LinkInbox(links[ATTITUDES], time),
            request=lambda _host_ns: request(),
            commands=[
                _RecordOutbox(record, topics.JOINT_COMMAND, name, links[f"planner->{name}"], time)
                for name in MODULES
            ],
            status=_RecordOutbox(record, topics.PLANNER_STATUS),
            checkpoint=checkpoints if traced else None,
            announce=None if beside is None else beside.announce,
        )
        self._session = 1
        self.loop: PlannerLoop | None = self._loop_of(make(1))

    def _loop_of(self, planner: Planner) -> PlannerLoop:
        return PlannerLoop(self._config, planner, self._ports, self._clock)

    @property
    def planner(self) -> Planner | None:
        """The planner; set it to None for a robot without one."""
        return None if self.loop is None else self.loop.planner

    @planner.setter
    def planner(self, planner: Planner | None) -> None:
        self.loop = None if planner is None else self._loop_of(planner)

    def advance(self) -> None:
        """Receive the states that have arrived, and tick if a tick is due."""
        if self.loop is None or self.frozen:
            return
        host_ns = self._clock()
        if self.loop.receive_states(host_ns):
            self.loop.tick(host_ns)

    def kill(self, *, for_good: bool) -> None:
        """Freeze the service; with `for_good` it is dead, and a restart replaces it."""
        self.frozen, self._is_dead = True, self._is_dead or for_good
        if self._is_dead and self._memory is not None:
            self._memory.ended = self._memory.planner

    def restart(self) -> None:
        """Continue a frozen planner; a dead planner is replaced, with the next session."""
        self.frozen = False
        if self._is_dead:
            self._is_dead = False
            self._session += 1
            self.planner = self._make(self._session)

    def resume(self, start: tuple[int, PlannerState] | None) -> None:
        """Continue from another run's planner: its session and state; None if it is dead."""
        if start is None:
            self.planner = None
            return
        self._session, state = start
        if self.planner is None or self.planner.session != self._session:
            self.planner = self._make(self._session)
        self.planner.state = copied(state)


class VirtualCan(Generic[S]):
    """A sensor's CAN bus: a frame is received as soon as it is sent."""

    def __init__(self, assembler: FrameGroup[S]) -> None:
        """Set the assembler of the sensor's frames."""
        self._assembler = assembler
        self._newest: S | None = None

    def poll(self) -> None:
        """Do nothing: no client has to be admitted."""

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        """Receive the frames of one sample."""
        for can_id, data in frames:
            self._newest = self._assembler.add(can_id, data) or self._newest

    def newest(self, _now_ns: int) -> S | None:
        """Return the newest sample since the last call, or None."""
        sample, self._newest = self._newest, None
        return sample


class VirtualHarness:
    """Service of the load cells; it starts with a tare, while the hoist holds the robot."""

    def __init__(
        self,
        config: RobotConfig,
        robot: SimulatedRobot,
        cells: VirtualCan[Vector6],
        network: VirtualNetwork,
        record: Record,
        *,
        time: VirtualTime,
        clock: HostClock,
    ) -> None:
        wrenches = _RecordOutbox(record, topics.WRENCH, "", network.links[WRENCHES], time)
        self._loop = HarnessLoop(cells, WrenchFilter(config.harness), wrenches, self)
        self._robot, self._time, self._clock = robot, time, time.on(clock)
        self._request: TareRequest | None = None

    def advance(self) -> None:
        """If a cycle is due, sample the wrench on the torso and run the cycle."""
        if not self._time.now_ns % self._robot.every.harness:
            self._robot.feel()
            self._loop.cycle(self._clock())

    def assume_tared(self) -> None:
        """Mark the tare as done: when a run is resumed, the cells carry the operator's load."""
        self._loop.state = tared_state(self._robot.harness.bias)

    def tare(self, request: TareRequest) -> None:
        """Request a new zero, from the next cycle on."""
        self._request = request

    def take(self) -> TareRequest | None:
        """Return the new request, or None."""
        request, self._request = self._request, None
        return request


class VirtualImu:
    """Service of the IMU, if one is fitted."""

    def __init__(
        self,
        config: RobotConfig,
        robot: SimulatedRobot,
        frames: VirtualCan[ImuSample],
        network: VirtualNetwork,
        record: Record,
        *,
        time: VirtualTime,
        clock: HostClock,
    ) -> None:
        self._robot, self._time, self._clock = robot, time, time.on(clock)
        attitudes = _RecordOutbox(record, topics.ATTITUDE, "", network.links[ATTITUDES], time)
        self._loop = ImuLoop(frames, AttitudeLaw(config.imu), attitudes)

    def advance(self) -> None:
        """If a cycle is due, sample the torso's attitude and run the cycle."""
        robot = self._robot
        if robot.imu is not None and not self._time.now_ns % robot.every.imu:
            robot.imu.send(robot.world)
            self._loop.cycle(self._clock())
