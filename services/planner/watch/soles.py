"""What the soles bear, by the joints' torques. Pure.

A sole whose centre of pressure reaches its edge tips, and a robot that is led is soft against that:
leaned on from the side it fell from 50 N on. HOLD is stiffer, and bears 65 N and more if it begins
while both soles are flat.
"""

from __future__ import annotations

import math

from shared.arrays import Array
from shared.bus.messages import Pair
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULE_INDEX, SIDES

ANKLES = tuple(2 * MODULE_INDEX[f"ankle_{side}"] for side in SIDES)
"""Indices of the ankles' phi among the joints."""
LOAD_MIN = 50.0
"""N; a sole that bears less counts as one that bears this."""


class Soles:
    """Loads of the right and the left sole."""

    def __init__(self, config: RobotConfig) -> None:
        self._half_width = 0.5 * config.geometry.w_foot
        self._leg_weight = config.leg_weight
        self._at_rest = 0.5 * (config.total_mass * GRAVITY + config.leg_weight)

    def loads(self, leg_loads: Pair) -> Pair:
        """Return what the soles bear, N: the legs' forces on the torso, and their own weight.

        NaN for a leg whose force is not known.

        Args:
            leg_loads: of the right and the left leg, N (`Measured.leg_loads`).
        """
        right, left = leg_loads
        return right + self._leg_weight, left + self._leg_weight

    def edge(self, tau: Array, loads: Pair) -> float:
        """Return how far out a sole's pressure is sideways: 0 below the ankle, 1 at its edge.

        The larger one of both; a load that is not known counts as half of the weight.

        Args:
            tau: joint torques (12,), N m.
            loads: of the soles, N.
        """
        out = 0.0
        for ankle, load in zip(ANKLES, loads, strict=True):
            borne = self._at_rest if math.isnan(load) else max(load, LOAD_MIN)
            out = max(out, abs(float(tau[ankle])) / borne)
        return out / self._half_width
