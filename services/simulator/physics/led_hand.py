"""The hand as somebody leads it in place of the scenario: within limits, never in jumps. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import HandLead, Vector3
from shared.clamp import clamp
from shared.config.scenarios import Lead

BANDWIDTH: Final = 8.0
"""rad/s, of the critically damped system with which the hand follows what is asked for."""
HEIGHT_MAX_RATE: Final = 0.25
"""m/s: the hand then pulls with up to 70 N; at 0.5 m/s with 150 N, where the planner lets go."""
PITCH_MAX_RATE: Final = 1.0
"""rad/s"""
HEIGHTS: Final = (0.78, 1.2)
"""Range of the torso's height, m: within what the legs reach."""
PITCHES: Final = (-0.3, 0.9)
"""Range of the torso's pitch, rad."""
PUSH_MAX: Final = 120.0
"""N, in each direction."""
PUSH_EXPIRES_S: Final = 0.3
"""After the last message: somebody who is gone does not go on pushing."""


class LedHand(msgspec.Struct):
    """Follows what is asked for; while nobody asks it stays where it was led, and pushes no more.

    Its fields, in this order, are `SimState.hand`.
    """

    leads: bool = False
    """Somebody leads; False: somebody pushes only, and the scenario leads."""
    height: float = 0.0
    height_rate: float = 0.0
    pitch: float = 0.0
    pitch_rate: float = 0.0
    wanted_height: float = 0.0
    wanted_pitch: float = 0.0
    force_x: float = 0.0
    force_y: float = 0.0
    force_z: float = 0.0
    push_left_s: float = 0.0

    def ask(self, asked: HandLead, now: Lead) -> None:
        """Accept a request, within the limits; a value that is not finite is ignored.

        The first one takes over from where the hand is led `now`.
        """
        if not all(map(math.isfinite, (asked.height, asked.pitch, *asked.push))):
            return
        if asked.leads and not self.leads:
            self.leads = True
            self.height, self.height_rate = now.height, now.height_rate
            self.pitch, self.pitch_rate = now.pitch, now.pitch_rate
        if asked.leads:
            self.wanted_height = clamp(asked.height, *HEIGHTS)
            self.wanted_pitch = clamp(asked.pitch, *PITCHES)
        self.force_x, self.force_y, self.force_z = (
            clamp(part, -PUSH_MAX, PUSH_MAX) for part in asked.push
        )
        self.push_left_s = PUSH_EXPIRES_S if self.force_x or self.force_y or self.force_z else 0.0

    def advance(self, dt: float) -> None:
        """Advance by dt, s."""
        if self.leads:
            self.height, self.height_rate = follow(
                self.wanted_height, self.height, self.height_rate, HEIGHT_MAX_RATE, dt
            )
            self.pitch, self.pitch_rate = follow(
                self.wanted_pitch, self.pitch, self.pitch_rate, PITCH_MAX_RATE, dt
            )
        self.push_left_s = max(0.0, self.push_left_s - dt)

    def over(self, wanted: Lead) -> Lead:
        """Return the scenario's request, with this hand's height and pitch if it leads."""
        if not self.leads:
            return wanted
        return wanted._replace(
            height=self.height,
            height_rate=self.height_rate,
            pitch=self.pitch,
            pitch_rate=self.pitch_rate,
        )

    def numbers(self) -> tuple[float, ...]:
        """Return the fields as the log has them."""
        return tuple(map(float, msgspec.structs.astuple(self)))

    @classmethod
    def of_numbers(cls, numbers: Sequence[float]) -> LedHand:
        """Return the hand that `numbers` were of."""
        leads, *rest = numbers
        return cls(leads > 0.0, *rest)

    @property
    def push(self) -> Vector3 | None:
        """Push on the torso, N, world; None: the scenario's own."""
        if self.push_left_s <= 0.0:
            return None
        return (self.force_x, self.force_y, self.force_z)


def follow(
    wanted: float, at: float, rate: float, rate_max: float, dt: float
) -> tuple[float, float]:
    """Return place and rate of a coordinate dt s later, on its way to where it is wanted.

    A critically damped second-order system with a limit on its rate; in closed form, so it is
    stable whatever dt is.
    """
    # x'' = w^2 (wanted - x) - 2 w x', whose error is (a + b t) exp(-w t)
    error, w = at - wanted, BANDWIDTH
    slope = rate + w * error
    decay = math.exp(-w * dt)
    then = wanted + (error + slope * dt) * decay
    rate = (slope - w * (error + slope * dt)) * decay
    if abs(rate) > rate_max or abs(then - at) > rate_max * dt:
        rate = math.copysign(rate_max, wanted - at)
        then = at + rate * dt
    return then, rate
