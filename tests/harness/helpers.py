"""What the tests of the harness share: a configuration, samples, a virtual CAN bus."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import can
import msgspec
import numpy as np
import numpy.typing as npt

from shared import config, loadcell_can
from shared.clock import NS_PER_MS
from shared.config import HarnessConfig, RobotConfig
from shared.loadcell_can import LegSample
from shared.messages import Vector6
from shared.process import DEFAULT_CONFIG
from shared.stewart import geometry_matrix

ROBOT = config.load(DEFAULT_CONFIG)
HARNESS = ROBOT.harness
G = geometry_matrix(HARNESS.base_radius, HARNESS.platform_radius, HARNESS.height)
PERIOD_NS = 4 * NS_PER_MS
ZERO: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def harness_with(**changes: object) -> HarnessConfig:
    return msgspec.structs.replace(HARNESS, **changes)


def robot_with(**simulation: object) -> RobotConfig:
    changed = msgspec.structs.replace(ROBOT.simulation, **simulation)
    return msgspec.structs.replace(ROBOT, simulation=changed)


def six(values: npt.ArrayLike) -> Vector6:
    return cast(Vector6, tuple(np.asarray(values, float).tolist()))


def legs(wrench: npt.ArrayLike) -> Vector6:
    """Return the leg forces of a wrench."""
    return six(np.linalg.solve(G, np.asarray(wrench, float)))


def sample(t_ns: int, forces: Sequence[float] = ZERO) -> LegSample:
    return LegSample(t_ns, cast(Vector6, tuple(forces)))


class CanHub:
    """Stands for the simulator's hub on any python-can bus."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        for can_id, data in frames:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def send_forces(self, forces: Sequence[float]) -> None:
        self.broadcast(loadcell_can.pack(forces))
