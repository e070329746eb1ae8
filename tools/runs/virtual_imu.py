"""The IMU of lockstep: the simulated sensor and the live loop, without a bus."""

from __future__ import annotations

from collections.abc import Callable

from services.imu.attitude import AttitudeLaw
from services.imu.loop import ImuLoop
from services.simulator.imu_front import ImuFront
from services.simulator.plant import ImuErrors
from services.simulator.world import World
from shared.clock import NS_PER_S
from shared.config_sections import ImuConfig
from shared.imu_can import ImuAssembler, ImuSample
from shared.messages import Attitude, Message
from shared.topics import ATTITUDE, Topic
from tools.runs.host_clock import HostClock, HostLink
from tools.runs.network import Link


class _Frames:
    """The sensor's CAN bus: what the front sends, the loop reads at once."""

    def __init__(self) -> None:
        self._assembler = ImuAssembler()
        self._newest: ImuSample | None = None

    def poll(self) -> None:
        """Do nothing: nobody has to be let in."""

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        """Take the frames of one sample."""
        for can_id, data in frames:
            self._newest = self._assembler.add(can_id, data) or self._newest

    def newest(self, _now_ns: int) -> ImuSample | None:
        """Return the newest sample since the last call, or None."""
        sample, self._newest = self._newest, None
        return sample


class VirtualImu:
    """Sensor and service in one."""

    def __init__(
        self,
        config: ImuConfig,
        errors: ImuErrors,
        attitudes: Link[Attitude],
        record: Callable[[Topic, str, Message], None],
        seed: int,
        clock: HostClock,
    ) -> None:
        """Mount the sensor, if one is fitted.

        Args:
            config: the robot's.
            errors: the plant's.
            attitudes: the link to the planner.
            record: takes every message.
            seed: of the noise.
            clock: of the service's host.
        """
        frames = _Frames()
        self._fitted = config.fitted
        self._period_ns = round(NS_PER_S / config.rate_hz)
        self._clock = clock
        self._front = ImuFront(errors, frames, seed)
        self._loop = ImuLoop(frames, AttitudeLaw(config), self)
        self._link, self._record = HostLink(attitudes), record

    def advance(self, world: World, now_ns: int) -> None:
        """If it is time, sample how the torso stands, and run one cycle of the service."""
        if not self._fitted or now_ns % self._period_ns:
            return
        self._link.now_ns = now_ns
        self._front.send(world)
        self._loop.cycle(self._clock.read(now_ns))

    def put(self, message: Attitude) -> bool:
        """Send an attitude to the planner and the log."""
        self._link.put(message.t_ns, message)
        self._record(ATTITUDE, "", message)
        return True
