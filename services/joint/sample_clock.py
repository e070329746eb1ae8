"""Counts the periods of a drive's samples, also those whose sample was lost. Pure.

A service that is held up reads two samples as one, or two within half a millisecond. By counting
its cycles, it would from then on send its states a cycle apart from the other modules
(`services.planner.state_phases`). So it counts the periods that have gone by.
"""

from __future__ import annotations

import msgspec

FOLLOW_SHIFT = 3
"""The clock follows a sample's time by an eighth: a single late sample counts as one."""


class SampleClock(msgspec.Struct):
    """Periods since the first sample.

    Attributes:
        count: of periods; 0 before the first.
        before: the count at the sample before.
    """

    count: int = 0
    before: int = 0
    at_ns: int = 0
    """When the present period began, smoothed."""

    def advance(self, now_ns: int, period_ns: int) -> None:
        """Take the time of a cycle, and the drive's period."""
        self.before = self.count
        if not self.count:
            self.count, self.at_ns = 1, now_ns
            return
        since_ns = now_ns - self.at_ns
        periods = max(0, (since_ns + period_ns // 2) // period_ns)
        self.count += periods
        self.at_ns += periods * period_ns
        self.at_ns += (now_ns - self.at_ns) >> FOLLOW_SHIFT

    def passed(self, every: int, phase: int) -> bool:
        """Return True if a period phase, phase + every, ... began since the sample before.

        With a sample lost, it is the next sample that passes it.
        """
        return (self.count - phase) // every > (self.before - phase) // every
