"""A sensor's CAN bus in lockstep: a frame is received as soon as it is sent."""

from __future__ import annotations

from typing import Generic, TypeVar

from shared.can.frame_group import FrameGroup
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig

S = TypeVar("S")


def whole_steps_ns(config: RobotConfig, rate_hz: float) -> int:
    """Return a sensor's period in whole steps of the world, ns, as the live simulator has it."""
    step_ns = round(config.simulation.timestep * NS_PER_S)
    return step_ns * max(1, round(NS_PER_S / (rate_hz * step_ns)))


class VirtualCan(Generic[S]):
    """The bus, and on its other end the newest sample."""

    def __init__(self, assembler: FrameGroup[S]) -> None:
        """Take what makes samples of the sensor's frames."""
        self._assembler = assembler
        self._newest: S | None = None

    def poll(self) -> None:
        """Do nothing: nobody has to be let in."""

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        """Take the frames of one sample."""
        for can_id, data in frames:
            self._newest = self._assembler.add(can_id, data) or self._newest

    def newest(self, _now_ns: int) -> S | None:
        """Return the newest sample since the last call, or None."""
        sample, self._newest = self._newest, None
        return sample
