"""The pendant, a dead man's handle: all six stop once it falls silent. Pure.

Whatever fails of the person's hand, a cable, a radio and a host between, it is silent. It beats in
each module's shared memory (`services.joint.will`), which needs no bus. One that was never heard,
or was laid down in order, is not missed.
"""

from __future__ import annotations

from shared.clock import NS_PER_MS


class PendantWatch:
    """Listens to it, for one module."""

    def __init__(self, silent_ms: float) -> None:
        """Take how long it may be silent."""
        self._silent_ns = round(silent_ms * NS_PER_MS)
        self._beats = 0
        self._heard_ns = 0

    def is_lost(self, now_ns: int, beats: int) -> bool:
        """Return True if there was one, and it has been silent for too long.

        Args:
            now_ns: this module's clock.
            beats: `WillFile.beats`, in each cycle.
        """
        if beats != self._beats:
            self._beats, self._heard_ns = beats, now_ns
        return beats > 0 and now_ns - self._heard_ns > self._silent_ns
