"""What the tests of the harness share: a configuration, leg forces, a scripted sensor and bus."""

from __future__ import annotations

from typing import cast

import msgspec
import numpy as np
import numpy.typing as npt

from services.harness.filter import WrenchFilter
from services.harness.loop import HarnessLoop, ZeroFile
from shared.bus.codec import encode
from shared.bus.messages import TareRequest, Vector6, Wrench
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import HarnessConfig
from shared.robot.stewart import geometry_matrix
from tests.robots import ROBOT

HARNESS = ROBOT.harness
G = geometry_matrix(HARNESS.base_radius, HARNESS.platform_radius, HARNESS.height)
PERIOD_NS = 4 * NS_PER_MS
T0 = 1_000 * NS_PER_S
TARE_CYCLES = round(HARNESS.tare_s * NS_PER_S / PERIOD_NS)
ZERO: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def harness_with(**changes: object) -> HarnessConfig:
    return msgspec.structs.replace(HARNESS, **changes)


def six(values: npt.ArrayLike) -> Vector6:
    return cast(Vector6, tuple(np.asarray(values, float).tolist()))


def legs(wrench: npt.ArrayLike) -> Vector6:
    """Return the leg forces of a wrench."""
    return six(np.linalg.solve(G, np.asarray(wrench, float)))


class ScriptedSensor:
    """Gives the forces it is told to."""

    def __init__(self) -> None:
        self.forces: Vector6 | None = ZERO

    def newest(self, _now_ns: int) -> Vector6 | None:
        return self.forces


class Sink:
    """A bus that encodes as the real one does and keeps the bytes."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []

    def put(self, message: Wrench) -> bool:
        self.payloads.append(encode(message))
        return True


class Asked:
    """Gives a request for a tare once it is told to."""

    def __init__(self) -> None:
        self.asked = False

    def take(self) -> TareRequest | None:
        asked, self.asked = self.asked, False
        return TareRequest(t_ns=0, seq=0, source="a test") if asked else None


def make_loop(
    asked: Asked | None = None, zero: ZeroFile | None = None
) -> tuple[HarnessLoop, ScriptedSensor, Sink]:
    sensor, sink = ScriptedSensor(), Sink()
    return HarnessLoop(sensor, WrenchFilter(HARNESS), sink, asked or Asked(), zero), sensor, sink


def cycles(loop: HarnessLoop, t_ns: int, count: int) -> tuple[Wrench, int]:
    assert count > 0
    for _ in range(count):
        message = loop.cycle(t_ns)
        t_ns += PERIOD_NS
    return message, t_ns
