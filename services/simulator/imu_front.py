"""The simulated IMU: the torso's true orientation, and the sensor's errors, as CAN frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from services.simulator.plant import ImuErrors
from services.simulator.world import World
from shared import imu_can


class FrameHub(Protocol):
    """The sensor's end of its simulated CAN bus."""

    def poll(self) -> object:
        """Admit new clients and take what they sent; never waits."""

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        """Send frames (id, data) to every client, as one packet."""


class ImuFront:
    """An IMU on the torso, its axes those of the torso but for its errors."""

    def __init__(self, errors: ImuErrors, hub: FrameHub, seed: int) -> None:
        """Take how wrong the sensor is.

        Args:
            errors: of the true plant.
            hub: takes the frames.
            seed: of the noise.
        """
        self._errors, self._hub = errors, hub
        roll, pitch = errors.tilt
        self._tilt = np.array(_product(_about(0, roll), _about(1, pitch)))
        self._random = np.random.default_rng((seed, 1))

    def send(self, world: World) -> None:
        """Send one sample of how the torso stands against gravity, and turns."""
        noise = self._errors.noise * self._random.standard_normal(2)
        turned = _product(world.torso_against_gravity(), self._tilt.tolist())
        told = _product(turned, _product(_about(0, noise[0]), _about(1, noise[1])))
        self._hub.poll()
        self._hub.broadcast(imu_can.pack(told, world.torso_rates(), valid=True))


def _about(axis: int, angle: float) -> list[float]:
    """Return the quaternion of a turn about x (0), y (1) or z (2), rad."""
    quaternion = [math.cos(0.5 * angle), 0.0, 0.0, 0.0]
    quaternion[1 + axis] = math.sin(0.5 * angle)
    return quaternion


def _product(a: Sequence[float] | npt.NDArray[np.float64], b: Sequence[float]) -> list[float]:
    """Return the product of two quaternions (w, x, y, z)."""
    w, x, y, z = a
    p, q, r, s = b
    return [
        w * p - x * q - y * r - z * s,
        w * q + x * p + y * s - z * r,
        w * r - x * s + y * p + z * q,
        w * s + x * r - y * q + z * p,
    ]
