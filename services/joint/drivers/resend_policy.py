"""Decides when gains, limits and modes are sent to an ODrive on CAN with a target. Pure.

A drive does not report whether it has received them, and a frame may be lost. A stiffness that is
wrongly on adds to the torques computed without it (25 N m for 100 ms in a study). A drive that
stays at the shipped limit of 2 turn/s, or in torque mode, would disturb the robot too.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from shared.bus.messages import Pair
from shared.clock import NS_PER_MS

GAINS_MS: Final = 100
"""Period at which unchanged gains are sent again, ms."""
DRIFT_MS: Final = 10
"""Time after which drifting gains are sent again, ms. Changed gains count as drifting if gains were
also sent within this time before the change: the next ones soon replace a lost frame, and the bus
has other traffic. Other changed gains are sent again with the next target."""
SETTLE_MS: Final = 1000
"""Time after `arm` in which limits and modes are sent every `GAINS_MS`, ms. A drive that is taken
over gets none, because firmware 0.5 disarms if the limit falls below the present current."""

Gains = tuple[Pair, Pair]
"""Position gains 1/s and velocity gains N m s/turn, of both axes."""

_NONE: Final[Gains] = ((0.0, 0.0), (0.0, 0.0))


class GainRow(IntEnum):
    """Frames that are sent with a target."""

    INPUTS = 0
    GAINS = 1
    """Inputs with gains."""
    ALL = 2
    """Inputs with gains, limits and modes."""


class ResendPolicy:
    """Tracks what was sent to the drive, and when.

    Attributes:
        gains: last gains sent; None if none were sent since the bus was opened.
    """

    def __init__(self) -> None:
        self.gains: Gains | None = None
        self._sent_ns = 0
        self._gains_at_ns = 0
        self._settle_at_ns = 0
        self._settle_until_ns = 0

    def connected(self) -> None:
        """Start over with a newly opened bus: the drive's values are unknown."""
        self.gains = None

    def armed(self, now_ns: int) -> None:
        """Start with a drive that was commanded to arm, without gains."""
        self.gains = _NONE
        self._gains_at_ns = self._settle_at_ns = 0
        self._settle_until_ns = now_ns + SETTLE_MS * NS_PER_MS

    def idle(self) -> None:
        """Stop sending limits and modes."""
        self._settle_until_ns = 0

    def with_target(self, gains: Gains, now_ns: int) -> GainRow:
        """Return the frames to send with a target, and count them as sent."""
        new = gains != self.gains
        due = new or now_ns >= self._gains_at_ns
        if due:
            drifting = now_ns - self._sent_ns < DRIFT_MS * NS_PER_MS
            wait_ms = GAINS_MS if not new else DRIFT_MS if drifting else 0
            self.gains, self._sent_ns = gains, now_ns
            self._gains_at_ns = now_ns + wait_ms * NS_PER_MS
        if self.with_torques(now_ns):
            return GainRow.ALL
        return GainRow.GAINS if due else GainRow.INPUTS

    def with_torques(self, now_ns: int) -> bool:
        """Return True if limits and modes are due, and count them as sent."""
        due = self._settle_at_ns <= now_ns < self._settle_until_ns
        if due:
            self._settle_at_ns = now_ns + GAINS_MS * NS_PER_MS
        return due

    def cut_off(self, row: GainRow) -> None:
        """Mark the last frames as unsent: the bus did not accept all of them."""
        if row >= GainRow.GAINS:
            self._gains_at_ns = 0
        if row is GainRow.ALL:
            self._settle_at_ns = 0
