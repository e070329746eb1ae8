"""The simulated harness sensor: the operator's wrench as load-cell frames (docs/law.md#harness)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from services.simulator.fronts.unix_can_hub import FrameHub
from shared.can import loadcell_can
from shared.config.robot_config import RobotConfig
from shared.robot import stewart

BIAS_MAX: Final = 20.0
"""Zero offset of a load cell: uniform within +- this, N; constant, so that tare matters."""


class HarnessFront:
    """Six load cells between torso and operator, fixed to the torso."""

    def __init__(self, config: RobotConfig, hub: FrameHub, seed: int) -> None:
        """Draw the zero offsets of this sensor.

        Args:
            config: gives the geometry, the cells' range and their noise.
            hub: takes the frames.
            seed: of the offsets and the noise.

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
        """Zero offset of each leg, N."""

    def send(
        self,
        force_torso: Sequence[float] | npt.NDArray[np.float64],
        moment_torso: Sequence[float] | npt.NDArray[np.float64],
    ) -> None:
        """Send one sample of the operator's force and moment on the torso.

        Args:
            force_torso: (3,) in N, torso axes.
            moment_torso: (3,) in N m about the harness point, torso axes.
        """
        forces = self._G_inverse @ np.concatenate((force_torso, moment_torso))
        forces += self.bias
        forces += self._noise * self._random.standard_normal(stewart.N_LEGS)
        np.maximum(forces, -self._leg_force_max, out=forces)
        np.minimum(forces, self._leg_force_max, out=forces)
        self._hub.poll()  # a load cell takes no requests, but clients that listen must be admitted
        self._hub.broadcast(loadcell_can.pack(forces.tolist()))
