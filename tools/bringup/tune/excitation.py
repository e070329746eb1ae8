"""The offsets of one reference: a step there and back, then sines of a few frequencies. Pure."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

BODY_RATE: Final = 6.0
"""rad/s; a body's natural frequency, which `FREQUENCIES_HZ` are about."""
FREQUENCIES_HZ: Final = (0.3, 0.5, 0.75, 1.1, 1.6, 2.3, 3.3)
CYCLES: Final = 4
"""Cycles of each sine; the first settles and is not used."""
SHORTEST_S: Final = 3.0
REST_S: Final = 1.0
HOLD_S: Final = 4.0
"""Time that a step is held."""


class SinePart(NamedTuple):
    """One sine of the excitation."""

    begin_s: float
    frequency_hz: float
    cycles: int

    @property
    def end_s(self) -> float:
        """When it ends, s."""
        return self.begin_s + self.cycles / self.frequency_hz


class Excitation(NamedTuple):
    """Step and sines of one size; of a module, a `tools.bringup.motion.AxisCourse`."""

    size: float
    """m or rad"""
    sines: tuple[SinePart, ...]

    @property
    def duration_s(self) -> float:
        """How long the whole takes, s."""
        return self.sines[-1].end_s + REST_S

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest offset, m or rad."""
        return -self.size, self.size

    @property
    def rate_max(self) -> float:
        """Fastest rate of the sines, m/s or rad/s."""
        return 2.0 * math.pi * max(sine.frequency_hz for sine in self.sines) * self.size

    def at(self, t_s: float) -> tuple[float, float]:
        """Return the offset at a time, m or rad, and no rate."""
        return self.offset(t_s), 0.0

    def offset(self, t_s: float) -> float:
        """Return the offset at a time, m or rad."""
        if t_s < REST_S + HOLD_S:
            return self.size if t_s >= REST_S else 0.0
        for sine in self.sines:
            if sine.begin_s <= t_s < sine.end_s:
                phase = 2.0 * math.pi * sine.frequency_hz * (t_s - sine.begin_s)
                return self.size * math.sin(phase)
        return 0.0


def excitation(size: float, scale: float = 1.0) -> Excitation:
    """Return step and sines of a size, m or rad, at a standing body's frequencies times `scale`."""
    begin_s, sines = REST_S + 2.0 * HOLD_S, []
    for hertz in (scale * one for one in FREQUENCIES_HZ):
        sine = SinePart(begin_s, hertz, max(CYCLES, math.ceil(SHORTEST_S * hertz) + 1))
        sines.append(sine)
        begin_s = sine.end_s
    return Excitation(size, tuple(sines))
