"""Refuses measurements that no sensor can have made. Pure."""

from __future__ import annotations

import math
from typing import Final

from shared.bus.messages import Attitude, JointState, Wrench
from shared.config.robot_config import RobotConfig
from shared.joints import N_MODULES

BEYOND_RAD: Final = 0.5
"""Largest angle beyond a soft stop, from the joint's elasticity or an error of its zero."""
SPEED_MAX: Final = 100.0
"""rad/s, five times the speed at which a drive limits its motor."""
TURN_MAX: Final = 100.0
"""rad/s, three times the range of the IMU in `docs/bring-up.md`; faster than any torso turns."""
UNIT_ERROR: Final = 0.1
"""How far a direction's length may be from 1."""
N_CELLS: Final = 6


class Plausible:
    """Bounds of each module's angles and speeds, of the wrench and of the attitude.

    The planner drops what lies beyond them as if it had not come: the sensor goes stale. A single
    angle or force of 1e300 would stay in the law's filters forever.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._force_max = N_CELLS * config.harness.leg_force_max
        arms = config.harness.base_radius + config.harness.platform_radius + config.harness.height
        self._moment_max = arms * self._force_max
        stops = [(low - BEYOND_RAD, high + BEYOND_RAD) for low, high in config.joint_limits()]
        self._stops = [(stops[2 * i], stops[2 * i + 1]) for i in range(N_MODULES)]

    def is_state(self, module: int, state: JointState) -> bool:
        """Return True if the module's angles and speeds are within the bounds."""
        (phi_low, phi_high), (theta_low, theta_high) = self._stops[module]
        phi, theta = state.q
        v_phi, v_theta = state.v
        return (
            phi_low <= phi <= phi_high
            and theta_low <= theta <= theta_high
            and abs(v_phi) <= SPEED_MAX
            and abs(v_theta) <= SPEED_MAX
        )

    def is_wrench(self, wrench: Wrench) -> bool:
        """Return True if the load cells together can have measured it."""
        return all(abs(part) <= self._force_max for part in wrench.force) and all(
            abs(part) <= self._moment_max for part in wrench.moment
        )

    def is_attitude(self, attitude: Attitude) -> bool:
        """Return True if up is a direction, and the torso can turn so fast."""
        length = math.hypot(*attitude.up)
        return (
            (not attitude.valid or abs(length - 1.0) <= UNIT_ERROR)
            and length <= 1.0 + UNIT_ERROR
            and all(abs(part) <= TURN_MAX for part in attitude.rate)
        )
