"""The pendant, a dead man's handle: all six modules stop when it falls silent. Pure.

Whatever fails between the person's hand and the robot, a cable, a radio or a host, shows as
silence. The pendant beats in each module's shared memory (`services.joint.rearm_guard`), without a
bus. A pendant that was never there, or was laid down in order, is not missed. Silence is counted in
cycles of the module, so a pause of the whole machine does not count.
"""

from __future__ import annotations

from typing import Final

from shared.clock import NS_PER_MS

CYCLE_MAX_NS: Final = 20 * NS_PER_MS
"""Most time between two cycles that counts as silence."""


class PendantWatch:
    """Listens to it, for one module.

    Attributes:
        lost: True while there is one that has been silent for too long.
    """

    def __init__(self, silent_ms: float) -> None:
        """Take how long it may be silent."""
        self._silent_ns = round(silent_ms * NS_PER_MS)
        self._beats = 0
        self._last_ns = 0
        self._silence_ns = 0
        self.lost = False

    def is_lost(self, now_ns: int, beats: int) -> bool:
        """Take one cycle; return `lost`.

        Args:
            now_ns: this module's clock.
            beats: `RearmGuard.beats`, in each cycle.
        """
        if beats == self._beats:
            self._silence_ns += min(CYCLE_MAX_NS, now_ns - self._last_ns)
        else:
            self._beats, self._silence_ns = beats, 0
        self._last_ns = now_ns
        self.lost = beats > 0 and self._silence_ns > self._silent_ns
        return self.lost
