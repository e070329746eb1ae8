"""The harness sensor of lockstep: simulated cells and the live loop, without a bus.

The frames of the simulated load cells go to the live service's own loop. Its messages go to a
modelled link and to the log (docs/architecture.md).
"""

from __future__ import annotations

from collections.abc import Callable

from services.harness.filter import WrenchFilter, tared_state
from services.harness.loop import HarnessLoop
from services.simulator.fronts.sensor_fronts import HarnessFront
from services.simulator.physics.world import World
from shared.bus.messages import Message, TareRequest, Vector6, Wrench
from shared.bus.topics import WRENCH, Topic
from shared.can.loadcell_can import LegSample, SampleAssembler
from shared.config.robot_config import RobotConfig
from tools.sim.host_clock import HostClock, HostLink
from tools.sim.network import VirtualLink
from tools.sim.virtual_can import VirtualCan, whole_steps_ns


class Cells(VirtualCan[Vector6]):
    """The sensor as the live loop has it."""

    def __init__(self) -> None:
        super().__init__(SampleAssembler())

    def read(self, now_ns: int) -> LegSample | None:
        """Return the newest sample since the last read, or None."""
        forces = self.newest(now_ns)
        return None if forces is None else LegSample(now_ns, forces)

    def close(self) -> None:
        """Do nothing: there is no link."""


class VirtualHarness:
    """Sensor and service in one; both begin with a tare, while the hoist holds."""

    def __init__(
        self,
        config: RobotConfig,
        wrenches: VirtualLink[Wrench],
        record: Callable[[Topic, str, Message], None],
        seed: int,
        clock: HostClock,
    ) -> None:
        """Draw the cells' zero offsets.

        Args:
            config: the robot.
            wrenches: the link to the planner.
            record: takes every message.
            seed: of the cells' offsets and noise.
            clock: of the service's host.
        """
        cells = Cells()
        self._front = HarnessFront(config, cells, seed)
        self._loop = HarnessLoop(cells, WrenchFilter(config.harness), self, self)
        self._link, self._record = HostLink(wrenches), record
        self._period_ns = whole_steps_ns(config, config.harness.rate_hz)
        self._clock = clock
        self._request: TareRequest | None = None

    def advance(self, world: World, now_ns: int) -> None:
        """If it is time, sample what acts on the torso, and run one cycle of the service."""
        if now_ns % self._period_ns:
            return
        self._link.now_ns = now_ns
        self._front.send(world.outside.harness_force, world.outside.harness_moment)
        self._loop.cycle(self._clock.read(now_ns))

    def assume_tared(self) -> None:
        """Set the tare as done: in the middle of a run the operator's load is on the cells."""
        self._loop.state = tared_state(self._front.bias)

    def tare(self, request: TareRequest) -> None:
        """Ask for a new zero, from the next cycle on."""
        self._request = request

    def put(self, message: Wrench) -> bool:
        """Send a wrench to the planner and the log."""
        self._link.put(message.t_ns, message)
        self._record(WRENCH, "", message)
        return True

    def take(self) -> TareRequest | None:
        """Return the request that has come, or None."""
        request, self._request = self._request, None
        return request
