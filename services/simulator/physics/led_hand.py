"""The hand as somebody leads it in place of the scenario: within limits, never in jumps. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from services.simulator.physics.follower import Follower
from shared.bus.messages import HandLead, Vector3
from shared.clamp import clamp
from shared.config.scenarios import Lead

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


class LedHand:
    """Follows what is asked for; while nobody asks it stays where it was led, and pushes no more.

    Attributes:
        leads: somebody leads; False: somebody pushes only, and the scenario leads.
    """

    def __init__(self) -> None:
        self.leads = False
        self._height, self._pitch = Follower(0.0, HEIGHT_MAX_RATE), Follower(0.0, PITCH_MAX_RATE)
        self._wanted = (0.0, 0.0)
        self._force: Vector3 = (0.0, 0.0, 0.0)
        self._push_left_s = 0.0

    def take(self, asked: HandLead, now: Lead) -> None:
        """Take a request, within the limits; a value that is not finite is ignored.

        Args:
            asked: where to lead and how to push.
            now: where the hand is led now; the first request takes over from there.
        """
        if not all(map(math.isfinite, (asked.height, asked.pitch, *asked.push))):
            return
        if asked.leads and not self.leads:
            self.leads = True
            self._height.at, self._pitch.at = now.height, now.pitch
            self._height.rate, self._pitch.rate = now.height_rate, now.pitch_rate
        if asked.leads:
            self._wanted = (clamp(asked.height, *HEIGHTS), clamp(asked.pitch, *PITCHES))
        x, y, z = (clamp(part, -PUSH_MAX, PUSH_MAX) for part in asked.push)
        self._force = (x, y, z)
        self._push_left_s = PUSH_EXPIRES_S if any(self._force) else 0.0

    def advance(self, dt: float) -> None:
        """Go on by dt, s."""
        if self.leads:
            self._height.advance(self._wanted[0], dt)
            self._pitch.advance(self._wanted[1], dt)
        self._push_left_s = max(0.0, self._push_left_s - dt)

    def over(self, wanted: Lead) -> Lead:
        """Return the scenario's request, with this hand's height and pitch if it leads."""
        if not self.leads:
            return wanted
        height, pitch = self._height, self._pitch
        return wanted._replace(
            height=height.at, height_rate=height.rate, pitch=pitch.at, pitch_rate=pitch.rate
        )

    @property
    def push(self) -> Vector3 | None:
        """Push on the torso, N, world; None: the scenario's own."""
        return self._force if self._push_left_s > 0.0 else None

    def state(self) -> tuple[float, ...]:
        """Return everything that `restored` goes on from."""
        height, pitch = self._height, self._pitch
        places = (height.at, height.rate, pitch.at, pitch.rate, *self._wanted)
        return (float(self.leads), *places, *self._force, self._push_left_s)

    @classmethod
    def restored(cls, state: Sequence[float]) -> LedHand:
        """Return the hand of a state."""
        made = cls()
        made.leads = state[0] > 0.0
        made._height.at, made._height.rate, made._pitch.at, made._pitch.rate = state[1:5]
        made._wanted = (state[5], state[6])
        made._force = (state[7], state[8], state[9])
        made._push_left_s = state[10]
        return made
