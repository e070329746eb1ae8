"""A joint service in virtual time, with its drive, its links and its view of the other modules."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from services.joint.controller import row_of
from services.joint.drive_manager import DriveManager
from services.joint.neighbours import UNKNOWN, NeighbourRow, NeighbourView, view_of
from services.joint.tracer import Tracer
from shared.bus import topics
from shared.bus.messages import JointCommand, JointEvent, JointState, Message
from shared.bus.topics import Topic
from shared.joints import MODULES
from tools.sim.host_clock import HostClock
from tools.sim.network import VirtualLink
from tools.sim.virtual_drive import VirtualDrive


class VirtualJoint:
    """A joint service's cycle, without process, bus or clock.

    Attributes:
        manager: the service itself.
        frozen: stopped or dead; it runs no cycle, and its drive keeps what it has.
        dead: killed; a restart makes a new service.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], DriveManager],
        drive: VirtualDrive,
        commands: VirtualLink[JointCommand],
        states: VirtualLink[JointState],
        record: Callable[[Topic, str, Message], None],
        *,
        clock: HostClock,
        traced: bool,
    ) -> None:
        """Start the service.

        Args:
            name: of the module.
            make: makes the service, now and at each restart.
            drive: the module's.
            commands: link from the planner.
            states: link to the planner.
            record: takes every message.
            clock: of the service's host.
            traced: record what re-execution needs.
        """
        self.name = name
        self.frozen = self.dead = False
        self._make, self._drive, self._clock = make, drive, clock
        self._commands, self._states, self._record = commands, states, record
        self._traced = traced
        self.manager = make()
        self._tracer = Tracer(self.manager)

    def cycle(self, now_ns: int, *, estop: bool, near: NeighbourView) -> JointEvent | None:
        """Run one cycle at a virtual time; return the change of mode, if there was one."""
        manager, host_ns = self.manager, self._clock.read(now_ns)
        inputs = (host_ns, self._drive.read(host_ns), self._commands.take(now_ns), estop)
        action = manager.step(*inputs, near)
        self._drive.carry_out(action, onboard=manager.onboard)
        if action.event is not None:
            self._record(topics.JOINT_EVENT, self.name, action.event)
        if manager.controller.is_state_due:
            state = manager.controller.state(host_ns)
            self._states.put(now_ns, state)
            self._record(topics.JOINT_STATE, self.name, state)
        if self._traced:
            trace = self._tracer.after(*inputs, action, near)
            if trace is not None:
                self._record(topics.JOINT_TRACE, self.name, trace)
        return action.event

    def neighbour_row(self, now_ns: int) -> NeighbourRow:
        """Return the row that the module's neighbours read, in virtual time as on one host.

        The row of a dead service stays, without new samples.
        """
        row = row_of(self.manager.controller)
        offset_ns = self._clock.read(now_ns) - now_ns
        if row.t_ns and not offset_ns:
            return row
        return row._replace(t_ns=row.t_ns - offset_ns if row.t_ns else int(self.dead))

    def kill(self, *, for_good: bool) -> None:
        """Freeze the service; `for_good`: it is dead, and a restart makes a new one."""
        self.frozen, self.dead = True, self.dead or for_good

    def restart(self) -> None:
        """Continue a frozen service; a dead one is replaced, and takes over its armed drive."""
        self.frozen = False
        if self.dead:
            self.dead = False
            self.manager = self._make()
            self._tracer = Tracer(self.manager)
            self._drive.start_service()


class NeighbourRows:
    """Rows that the joint services of a host exchange within a cycle of lockstep.

    They run one after the other: each reads the rows of those before it as they are after this
    cycle, as from shared memory (`services.joint.neighbours`).
    """

    def __init__(self, joints: Sequence[VirtualJoint], now_ns: int) -> None:
        """Begin a cycle at a virtual time."""
        self._joints, self._now_ns = joints, now_ns
        self._rows: list[NeighbourRow] = []

    def view(self, index: int) -> NeighbourView:
        """Return a module's view of the others, before it runs its cycle."""
        joints, now_ns, rows = self._joints, self._now_ns, self._rows
        if not joints[index].manager.needs_neighbours:
            return UNKNOWN
        if not rows:
            rows += [joint.neighbour_row(now_ns) for joint in joints]
        return view_of(MODULES[index], rows, now_ns)

    def write(self, index: int) -> None:
        """Take a module's row, after it has run its cycle."""
        if self._rows:
            self._rows[index] = self._joints[index].neighbour_row(self._now_ns)
