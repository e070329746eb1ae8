"""The planner's process in virtual time, with its links."""

from __future__ import annotations

from collections.abc import Callable

from services.planner.checkpoint import Checkpoints
from services.planner.intents import OperatorRequest
from services.planner.planner import Planner, PlannerState
from shared.bus import topics
from shared.bus.messages import Message
from shared.bus.topics import Topic
from shared.joints import MODULES
from tools.sim.host_clock import HostClock
from tools.sim.virtual_network import VirtualNetwork


class VirtualPlanner:
    """The planner's cycle, without process, bus or clock.

    Attributes:
        planner: the service itself; None: there is none.
        frozen: stopped or dead.
    """

    def __init__(
        self,
        make: Callable[[int], Planner],
        network: VirtualNetwork,
        record: Callable[[Topic, str, Message], None],
        *,
        rate_hz: float,
        clock: HostClock,
        traced: bool,
    ) -> None:
        """Start the service.

        Args:
            make: makes a planner with a session, now and at each restart.
            network: its links.
            record: takes every message.
            rate_hz: of its ticks.
            clock: of its host.
            traced: record what re-execution needs.
        """
        self.planner: Planner | None = make(1)
        self.frozen = False
        self._dead = False
        self._session = 1
        self._make, self._record, self._clock = make, record, clock
        self._states, self._commands = network.states(), network.commands()
        self._wrenches, self._attitudes = network.wrenches(), network.attitudes()
        self._rate_hz, self._traced = rate_hz, traced
        self._checkpoints = Checkpoints(rate_hz)

    def advance(self, now_ns: int, request: Callable[[], OperatorRequest]) -> None:
        """Receive what has arrived by a virtual time, and tick if a tick is due.

        Args:
            now_ns: virtual time.
            request: returns what the operator requests.
        """
        planner = self.planner
        if planner is None or self.frozen:
            return
        host_ns = self._clock.read(now_ns)
        for index, link in enumerate(self._states):
            state = link.take(now_ns)
            if state is not None:
                planner.receive_state(index, state, host_ns)
        if not planner.is_due(host_ns):
            return
        wrench = self._wrenches.take(now_ns)
        if wrench is not None:
            planner.receive_wrench(wrench, host_ns)
        attitude = self._attitudes.take(now_ns)
        if attitude is not None:
            planner.receive_attitude(attitude, host_ns)
        planner.receive_request(request())
        for index, command in enumerate(planner.tick(host_ns)):
            self._commands[index].put(now_ns, command)
            self._record(topics.JOINT_COMMAND, MODULES[index], command)
        self._record(topics.PLANNER_STATUS, "", planner.status(host_ns, 0.0))
        checkpoint = self._checkpoints.after(planner, host_ns) if self._traced else None
        if checkpoint is not None:
            self._record(topics.PLANNER_CHECKPOINT, "", checkpoint)

    def kill(self, *, for_good: bool) -> None:
        """Freeze the service; `for_good`: it is dead, and a restart makes a new one."""
        self.frozen, self._dead = True, self._dead or for_good

    def restart(self) -> None:
        """Continue a frozen planner; a dead one is replaced under the next session."""
        self.frozen = False
        if self._dead:
            self._dead = False
            self._session += 1
            self.planner = self._make(self._session)
            self._checkpoints = Checkpoints(self._rate_hz)

    def resume(self, start: tuple[int, PlannerState] | None) -> None:
        """Continue from another run's planner: its session and state; None: it is dead."""
        if start is None:
            self.planner = None
            return
        self._session, state = start
        self.planner = self._make(self._session)
        self.planner.restore(state)
