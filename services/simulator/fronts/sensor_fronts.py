"""The simulated sensors as CAN frames: the load cells (docs/law.md#harness), and the IMU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from services.simulator.physics.plant import ImuErrors
from services.simulator.physics.world import World
from shared.can.sensor_frames import pack_forces, pack_imu
from shared.config.robot_config import RobotConfig
from shared.config.sections import ImuConfig
from shared.robot import stewart


class FrameHub(Protocol):
    """Interface of the CAN bus to a simulated sensor."""

    def poll(self) -> object:
        """Admit new clients and return the frames that they sent; never blocks."""

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        """Send frames (id, data) to every client, as one packet."""


BIAS_MAX: Final = 20.0
"""Maximum zero offset of a load cell, N. Offsets are constant, and uniformly distributed between
minus and plus this value."""


class HarnessFront:
    """Six load cells between torso and operator, fixed to the torso."""

    def __init__(self, config: RobotConfig, hub: FrameHub, seed: int) -> None:
        """Draw the zero offsets of this sensor; `seed` also seeds its noise.

        Raises:
            ConfigError: the geometry is singular.
        """
        harness = config.harness
        G = stewart.geometry_matrix(harness.base_radius, harness.platform_radius, harness.height)
        self._G_inverse = np.linalg.inv(G)
        self._hub = hub
        self._leg_force_max = harness.leg_force_max
        self._noise = config.simulation.harness_noise
        self._random = np.random.default_rng(seed)
        self.bias = self._random.uniform(-BIAS_MAX, BIAS_MAX, stewart.N_LEGS)
        """Zero offset of each load cell, N."""

    def send(
        self,
        force_torso: Sequence[float] | npt.NDArray[np.float64],
        moment_torso: Sequence[float] | npt.NDArray[np.float64],
    ) -> None:
        """Send one sample of the operator's force (3,), N, and moment (3,), N m, on the torso.

        Both are in torso axes; the moment is about the harness point.
        """
        forces = self._G_inverse @ np.concatenate((force_torso, moment_torso))
        forces += self.bias
        forces += self._noise * self._random.standard_normal(stewart.N_LEGS)
        np.maximum(forces, -self._leg_force_max, out=forces)
        np.minimum(forces, self._leg_force_max, out=forces)
        self._hub.poll()  # a load cell ignores requests, but new clients must be admitted
        self._hub.broadcast(pack_forces(forces.tolist()))


class ImuFront:
    """An IMU on the torso, mounted as in the robot file, with the plant's errors."""

    def __init__(self, config: ImuConfig, errors: ImuErrors, hub: FrameHub, seed: int) -> None:
        """Mount the sensor as in `config`, with the plant's errors."""
        self._errors, self._hub = errors, hub
        roll, pitch = errors.tilt
        tilt = _product(_about(0, roll), _about(1, pitch))
        roll, pitch, yaw = config.mounting
        mounting = _product(_about(2, yaw), _product(_about(0, roll), _about(1, pitch)))
        self._mounting = _product(tilt, mounting)
        """Quaternion that rotates sensor axes to torso axes."""
        self._random = np.random.default_rng((seed, 1))

    def send(self, world: World) -> None:
        """Send a sample of the torso's orientation relative to gravity and its angular velocity."""
        noise = self._errors.noise * self._random.standard_normal(2)
        turned = _product(world.torso_against_gravity(), self._mounting)
        measured = _product(turned, _product(_about(0, noise[0]), _about(1, noise[1])))
        w, x, y, z = self._mounting
        back = (w, -x, -y, -z)
        _, *rate = _product(back, _product((0.0, *world.torso_rates()), self._mounting))
        self._hub.poll()
        self._hub.broadcast(pack_imu(measured, rate, valid=True))


def _about(axis: int, angle: float) -> list[float]:
    """Return the quaternion of a rotation about x (0), y (1) or z (2), rad."""
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
