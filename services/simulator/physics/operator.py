"""The simulated operator: a hand that leads, and weight rested on the harness.

The hand is a clipped spring-damper between a path and the harness point, in height and
pitch (docs/simulator.md#reference-scenario), and sideways where a scenario says so. Behind it is a
person with a mass, which yields in height. Pure.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import msgspec

from services.simulator.physics.plant import Person
from shared.bus.messages import Vector3
from shared.clamp import clamp
from shared.config.scenarios import Lead
from shared.config.sections import OperatorConfig


class HandForce(NamedTuple):
    """The hand's force and moment on the torso."""

    force_z: float
    """N, world, at the harness point."""
    moment_pitch: float
    """N m about the torso's pitch axis."""


REACH_S: Final = 0.4
"""Time constant with which a hand that grips the robot joins the path."""


class Wearer(msgspec.Struct):
    """The person's own mass behind the hand, which yields to the robot's force.

    It grips the robot where that is and joins the path. From then on d is its height above the
    path:  m d'' = -m w^2 d - 2 zeta m w d' - f. Without a mass it follows the path exactly.
    """

    person: Person
    above: float = 0.0
    """m"""
    rate: float = 0.0
    """m/s"""
    load_n: float = 0.0
    """What rests on the harness, N."""
    reach: float = 0.0
    """m, the path is so far off still, since it took hold: gone before a scenario starts."""
    holds: bool = False

    def grip(self, above: float) -> None:
        """Grip the robot where it is, `above` the path, m, unless the hand grips already."""
        if not self.holds:
            self.holds, self.reach = True, above

    def motion(self) -> tuple[float, float]:
        """Return how far the hand is above its path, m, and its rate, m/s."""
        return self.above + self.reach, self.rate - self.reach / REACH_S

    def step(self, dt: float, force_on_robot: float, assist: float) -> None:
        """Advance by dt, s, under the hand's force on the robot, N, up.

        Of the assist that it requests, N, the person rests a part, with a delay.
        """
        person = self.person
        if person.mass > 0.0:
            w = 2.0 * math.pi * person.leg_frequency_hz
            b = 2.0 * person.leg_damping_ratio * w
            acceleration = -(1.0 / person.mass) * force_on_robot - w * w * self.above
            self.rate = (self.rate + dt * acceleration) / (1.0 + dt * b)
            self.above += dt * self.rate
        self.reach -= self.reach * dt / REACH_S
        wanted, lag = person.load_scale * assist, person.load_lag_s
        self.load_n += (wanted - self.load_n) * (min(1.0, dt / lag) if lag > 0.0 else 1.0)


class Operator:
    """The hand's spring-damper."""

    def __init__(self, hand: OperatorConfig, harness_point: Vector3) -> None:
        """Take the spring-damper and where on the torso it acts, m, torso axes."""
        self._hand = hand
        self._point = harness_point

    def force(
        self, wanted: Lead, height: float, rate: float, pitch: float, pitch_rate: float
    ) -> HandForce:
        """Return the hand's force, from where it leads and where the robot is.

        `height` is the harness point's above the ankles, m, `pitch` the torso's, rad.
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
            clamp(force, -hand.force_max, hand.force_max),
            clamp(moment, -hand.moment_max, hand.moment_max),
        )

    def force_side(self, wanted: Lead, side: float, rate: float) -> float:
        """Return the hand's force along world y, N; 0 where nothing holds it sideways.

        The harness point is at `side`, m, and moves at `rate`, m/s.
        """
        if wanted.side is None:
            return 0.0
        hand = self._hand
        force = hand.k_y * (wanted.side - side) + hand.b_y * (wanted.side_rate - rate)
        return clamp(force, -hand.force_max, hand.force_max)
