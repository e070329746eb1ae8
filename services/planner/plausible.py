"""What a joint can have measured: the planner reckons with nothing else. Pure."""

from __future__ import annotations

from typing import Final

from shared.config import RobotConfig
from shared.joints import N_MODULES
from shared.messages import JointState

BEYOND_RAD: Final = 0.5
"""A joint gives so far beyond its soft stop at most, or its zero is so far off."""
SPEED_MAX: Final = 100.0
"""rad/s, five times what a drive lets its motor do."""


class Plausible:
    """Bounds of what is heard from each module.

    A state beyond them is no state: the module goes stale, and the planner holds. One angle that
    is no number, or 1e308, would stay in the law's filters for ever.
    """

    def __init__(self, config: RobotConfig) -> None:
        """Take the soft stops."""
        stops = [(low - BEYOND_RAD, high + BEYOND_RAD) for low, high in config.joint_limits()]
        self._stops = [(stops[2 * i], stops[2 * i + 1]) for i in range(N_MODULES)]

    def is_state(self, module: int, state: JointState) -> bool:
        """Return True if the module's angles and speeds can be."""
        (phi_low, phi_high), (theta_low, theta_high) = self._stops[module]
        phi, theta = state.q
        v_phi, v_theta = state.v
        return (
            phi_low <= phi <= phi_high
            and theta_low <= theta <= theta_high
            and abs(v_phi) <= SPEED_MAX
            and abs(v_theta) <= SPEED_MAX
        )
