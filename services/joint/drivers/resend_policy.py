"""When an ODrive on CAN is told its gains, limits and modes along with a target. Pure.

Nothing shows whether a drive has taken them, and a frame may have been lost: a stiffness that
should be off, and is not, adds to the torques that are worked out without it (25 N m for 100 ms
in the study); 2 turn/s or torque mode would be felt as well.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from shared.bus.messages import Pair
from shared.clock import NS_PER_MS

GAINS_MS: Final = 100
"""Gains go to the drive when they change, and this often."""
DRIFT_MS: Final = 10
"""Gains that change go once more with the next target; those that have changed within so long
before, only after as long: they drift, a lost one is soon replaced, and the bus has other work."""
SETTLE_MS: Final = 1000
"""So long after `arm`, or the first target, limits and modes are told every `GAINS_MS`."""

Gains = tuple[Pair, Pair]
"""Position gains 1/s and velocity gains N m s/turn, of both axes."""

_NONE: Final[Gains] = ((0.0, 0.0), (0.0, 0.0))


class GainRow(IntEnum):
    """What goes out with a target."""

    INPUTS = 0
    GAINS = 1
    """Inputs with gains."""
    ALL = 2
    """Inputs with gains, limits and modes."""


class ResendPolicy:
    """Remembers what the drive was told, and when.

    Attributes:
        gains: that were told last; None: nothing since the bus was opened.
    """

    def __init__(self) -> None:
        self.gains: Gains | None = None
        self._told_ns = 0
        self._gains_at_ns = 0
        self._settle_at_ns = 0
        self._settle_until_ns = 0

    def connected(self) -> None:
        """Begin with a bus that was opened: the drive has what it has."""
        self.gains = None

    def armed(self, now_ns: int) -> None:
        """Begin with a drive that was asked to arm, without gains."""
        self.gains = _NONE
        self._gains_at_ns = 0
        self._settle(now_ns)

    def idle(self) -> None:
        """Stop telling limits and modes."""
        self._settle_until_ns = 0

    def with_target(self, gains: Gains, now_ns: int) -> GainRow:
        """Return what goes with a target that has these gains, and take it for told."""
        new = gains != self.gains
        due = new or now_ns >= self._gains_at_ns
        if self.gains is None:  # taken over as it stands
            self._settle(now_ns)
        if due:
            drifting = now_ns - self._told_ns < DRIFT_MS * NS_PER_MS
            wait_ms = GAINS_MS if not new else DRIFT_MS if drifting else 0
            self.gains, self._told_ns = gains, now_ns
            self._gains_at_ns = now_ns + wait_ms * NS_PER_MS
        if self.with_torques(now_ns):
            return GainRow.ALL
        return GainRow.GAINS if due else GainRow.INPUTS

    def with_torques(self, now_ns: int) -> bool:
        """Return whether limits and modes are due, and take them for told."""
        due = self._settle_at_ns <= now_ns < self._settle_until_ns
        if due:
            self._settle_at_ns = now_ns + GAINS_MS * NS_PER_MS
        return due

    def cut_off(self, row: GainRow) -> None:
        """Take back what was told last: the bus did not take all of it."""
        if row >= GainRow.GAINS:
            self._gains_at_ns = 0
        if row is GainRow.ALL:
            self._settle_at_ns = 0

    def _settle(self, now_ns: int) -> None:
        self._settle_at_ns = 0
        self._settle_until_ns = now_ns + SETTLE_MS * NS_PER_MS
