"""Height, pitch and assist that a person commands with sticks or keys, within limits."""

from __future__ import annotations

from typing import Final, NamedTuple

from services.simulator.physics.operator import HEIGHTS, PITCHES
from shared.clamp import clamp

HEIGHT_RATE: Final = 0.15
"""m/s at full deflection."""
PITCH_RATE: Final = 0.4
"""rad/s at full deflection."""
ASSIST_RATE: Final = 40.0
"""N/s at full deflection."""
DEAD_ZONE: Final = 0.2
"""Deflections up to this count as zero: a worn stick rests up to 15 % off its old position."""


class Deflection(NamedTuple):
    """Deflections that command height, pitch and assist, each from -1 to 1."""

    height: float = 0.0
    pitch: float = 0.0
    assist: float = 0.0


class Led(NamedTuple):
    """Position of the hand and request for assist."""

    height: float
    """m"""
    pitch: float
    """rad"""
    assist_n: float


class Pilot:
    """Integrates deflections; `led` is the result."""

    def __init__(self, height: float, pitch: float, assist_max_n: float) -> None:
        self._assist_max_n = assist_max_n
        self.led = Led(clamp(height, *HEIGHTS), clamp(pitch, *PITCHES), 0.0)

    def limit_assist(self, given_n: float) -> None:
        """Reduce the request to at most the assist that the planner gives now, N."""
        self.led = self.led._replace(assist_n=max(0.0, min(self.led.assist_n, given_n)))

    def integrate(self, wanted: Deflection, dt: float) -> Led:
        """Integrate deflections over dt, s."""
        height, pitch, assist_n = self.led
        self.led = Led(
            clamp(height + HEIGHT_RATE * _beyond(wanted.height) * dt, *HEIGHTS),
            clamp(pitch + PITCH_RATE * _beyond(wanted.pitch) * dt, *PITCHES),
            clamp(assist_n + ASSIST_RATE * _beyond(wanted.assist) * dt, 0.0, self._assist_max_n),
        )
        return self.led


def _beyond(deflection: float) -> float:
    """Return a deflection without its dead zone; 0 if it is not a number."""
    size = min(1.0, abs(deflection)) if deflection == deflection else 0.0
    if size <= DEAD_ZONE:
        return 0.0
    scaled = (size - DEAD_ZONE) / (1.0 - DEAD_ZONE)
    return scaled if deflection > 0.0 else -scaled
