"""The simulated IMU: the torso's true orientation, and the sensor's errors, as CAN frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from services.simulator.fronts.unix_can_hub import FrameHub
from services.simulator.physics.plant import ImuErrors
from services.simulator.physics.world import World
from shared.can import imu_can
from shared.config.sections import ImuConfig


class ImuFront:
    """An IMU on the torso, mounted as the robot file says but for its errors."""

    def __init__(self, config: ImuConfig, errors: ImuErrors, hub: FrameHub, seed: int) -> None:
        """Mount the sensor.

        Args:
            config: the robot's: how it sits on the torso.
            errors: of the true plant.
            hub: takes the frames.
            seed: of the noise.
        """
        self._errors, self._hub = errors, hub
        roll, pitch = errors.tilt
        tilt = _product(_about(0, roll), _about(1, pitch))
        roll, pitch, yaw = config.mounting
        mounting = _product(_about(2, yaw), _product(_about(0, roll), _about(1, pitch)))
        self._mounting = _product(tilt, mounting)
        """Turns sensor axes into torso axes."""
        self._random = np.random.default_rng((seed, 1))

    def send(self, world: World) -> None:
        """Send one sample of how the torso stands against gravity, and turns."""
        noise = self._errors.noise * self._random.standard_normal(2)
        turned = _product(world.torso_against_gravity(), self._mounting)
        measured = _product(turned, _product(_about(0, noise[0]), _about(1, noise[1])))
        w, x, y, z = self._mounting
        back = (w, -x, -y, -z)
        _, *rate = _product(back, _product((0.0, *world.torso_rates()), self._mounting))
        self._hub.poll()
        self._hub.broadcast(imu_can.pack(measured, rate, valid=True))


def _about(axis: int, angle: float) -> list[float]:
    """Return the quaternion of a turn about x (0), y (1) or z (2), rad."""
    quaternion = [math.cos(0.5 * angle), 0.0, 0.0, 0.0]
    quaternion[1 + axis] = math.sin(0.5 * angle)
    return quaternion


def _product(a: Sequence[float], b: Sequence[float]) -> list[float]:
    """Return the product of two quaternions (w, x, y, z)."""
    w, x, y, z = a
    p, q, r, s = b
    return [
        w * p - x * q - y * r - z * s,
        w * q + x * p + y * s - z * r,
        w * r - x * s + y * p + z * q,
        w * s + x * r - y * q + z * p,
    ]
