"""Counts drop-outs, so that whoever engages again waits the longer the more there were. Pure.

A joint service counts those of its commands, the planner those of its modules
(docs/architecture.md#modes). Links that fail in turn would otherwise make the robot flap between
TRACK and HOLD.
"""

from __future__ import annotations

import msgspec


class Dropouts(msgspec.Struct):
    """Recent drop-outs; each steady time without one forgets one."""

    count: int = 0
    last_ns: int = 0
    """Time of the last drop-out."""
    steady_since_ns: int = 0
    """Start of the present time engaged without a drop-out; restarts when one is forgotten."""

    def advance(
        self, now_ns: int, *, engaged: bool, dropped: bool, count_max: int, forget_ns: int
    ) -> None:
        """Advance by one cycle.

        Args:
            now_ns: clock of the host.
            engaged: before this cycle, the module tracked or the planner led.
            dropped: in this cycle it dropped out.
            count_max: more are not counted: they would only take longer to forget.
            forget_ns: steady time that forgets one.
        """
        if not engaged:
            self.steady_since_ns = now_ns
        elif dropped:
            self.count = min(self.count + 1, count_max)
            self.last_ns = self.steady_since_ns = now_ns
        elif self.count and now_ns - self.steady_since_ns >= forget_ns:
            self.count -= 1
            self.steady_since_ns = now_ns
