"""Rejects joint states that no joint can have measured. Pure."""

from __future__ import annotations

from typing import Final

from shared.config import RobotConfig
from shared.joints import N_MODULES
from shared.messages import JointState

BEYOND_RAD: Final = 0.5
"""Largest angle beyond a soft stop, from the joint's elasticity or an error of its zero."""
SPEED_MAX: Final = 100.0
"""rad/s, five times the speed at which a drive limits its motor."""


class Plausible:
    """Bounds of each module's angles and speeds.

    The planner drops a state beyond them: the module goes stale and the planner holds. A single
    angle of NaN or 1e308 would stay in the law's filters forever.
    """

    def __init__(self, config: RobotConfig) -> None:
        """Compute the bounds from the soft stops."""
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
