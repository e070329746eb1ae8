"""The simulated operator: a hand that leads, and weight rested on the harness.

The hand is a clipped spring-damper between a path and the harness point, in height and
pitch (design section 8). Pure.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from shared.config import RobotConfig
from shared.scenario import Lead


class HandForce(NamedTuple):
    """What the hand does to the torso."""

    force_z: float
    """N, world, at the harness point."""
    moment_pitch: float
    """N m about the torso's pitch axis."""


class Operator:
    """The hand's spring-damper."""

    def __init__(self, config: RobotConfig) -> None:
        """Take the spring-damper and the harness point."""
        self._hand = config.simulation.operator
        self._point = config.geometry.harness_point

    def force(
        self, wanted: Lead, height: float, rate: float, pitch: float, pitch_rate: float
    ) -> HandForce:
        """Return the hand's force.

        Args:
            wanted: where the hand leads: torso height and pitch.
            height: of the harness point above the ankles, m.
            rate: of the harness point, vertical, m/s.
            pitch: of the torso, rad.
            pitch_rate: rad/s.
        """
        x, _, z = self._point
        sine, cosine = math.sin(wanted.pitch), math.cos(wanted.pitch)
        point_height = wanted.height - x * sine + z * cosine
        point_rate = wanted.height_rate - (x * cosine + z * sine) * wanted.pitch_rate
        hand = self._hand
        force = hand.k_z * (point_height - height) + hand.b_z * (point_rate - rate)
        moment = hand.k_pitch * (wanted.pitch - pitch) + hand.b_pitch * (
            wanted.pitch_rate - pitch_rate
        )
        return HandForce(
            min(hand.force_max, max(-hand.force_max, force)),
            min(hand.moment_max, max(-hand.moment_max, moment)),
        )
