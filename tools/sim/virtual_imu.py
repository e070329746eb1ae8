"""The IMU of lockstep: the simulated sensor and the live loop, without a bus."""

from __future__ import annotations

from collections.abc import Callable

from services.imu.attitude import AttitudeLaw
from services.imu.loop import ImuLoop
from services.simulator.fronts.sensor_fronts import ImuFront
from services.simulator.physics.plant import ImuErrors
from services.simulator.physics.world import World
from shared.bus.messages import Attitude, Message
from shared.bus.topics import ATTITUDE, Topic
from shared.can.imu_can import ImuAssembler
from shared.config.robot_config import RobotConfig
from tools.sim.host_clock import HostClock, HostLink
from tools.sim.network import VirtualLink
from tools.sim.virtual_can import VirtualCan, whole_steps_ns


class VirtualImu:
    """Sensor and service in one."""

    def __init__(
        self,
        config: RobotConfig,
        errors: ImuErrors,
        attitudes: VirtualLink[Attitude],
        record: Callable[[Topic, str, Message], None],
        seed: int,
        clock: HostClock,
    ) -> None:
        """Mount the sensor, if one is fitted.

        Args:
            config: the robot.
            errors: the plant's.
            attitudes: the link to the planner.
            record: takes every message.
            seed: of the noise.
            clock: of the service's host.
        """
        frames = VirtualCan(ImuAssembler())
        self._fitted = config.imu.fitted
        self._period_ns = whole_steps_ns(config, config.imu.rate_hz)
        self._clock = clock
        self._front = ImuFront(config.imu, errors, frames, seed)
        self._loop = ImuLoop(frames, AttitudeLaw(config.imu), self)
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
