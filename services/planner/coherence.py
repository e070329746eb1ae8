"""How far apart in time the six modules act, and how much of tau_coupled they get for it. Pure.

tau_coupled is feedback from all six modules to all six (design section 3 c): it is right only if
they act on it at about the same time. With one knee 22 ms late each way, every command within
the age rule, the robot shook until it fell; late by the same in all six it harmed nobody.
What tau_coupled does not hold is held by stiffer local gains (`services.joint.controller`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import msgspec

from shared.clock import NS_PER_MS

WHOLE_NS: Final = 4 * NS_PER_MS
"""Mean spread of ages up to which all of it is given: a tick of the planner. With both hips 8 ms
later than the rest and all of it, knees and hips shook at 49 Hz after 4 s, without any push."""
NONE_NS: Final = 10 * NS_PER_MS
"""And from which on none is: at 12 ms two fifths of it were clean, three fifths were not."""
MOST_NS: Final = 60 * NS_PER_MS
"""A larger spread counts as this: a module that was long away is not remembered for long."""
TICKS: Final = 32
"""Over which the spread is averaged: 0.13 s."""


class Coherence(msgspec.Struct):
    """The running mean of the spread of the modules' command ages."""

    spread_ns: float = 0.0

    def take(self, ages_ns: Sequence[int]) -> None:
        """Take the age of the command that each module acts on; -1: it has none."""
        youngest = min(ages_ns)
        if youngest >= 0:
            spread_ns = min(max(ages_ns) - youngest, MOST_NS)
            self.spread_ns += (spread_ns - self.spread_ns) / TICKS

    def share(self, wanted: Iterable[float]) -> float:
        """Return how much of tau_coupled all six get: 1 while they act together, 0 if apart.

        Never more than any of them would use: one that does without, among five that do not,
        is held by nobody's certificate.

        Args:
            wanted: per module, `JointState.coupled_share`.
        """
        together = (NONE_NS - self.spread_ns) / (NONE_NS - WHOLE_NS)
        return max(0.0, min(1.0, together, *wanted))
