"""A CAN bus in virtual time, with the kernel's queue in front of it (`shared.can.interface`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from services.simulator.drives.axis_bank import AxisBank
from shared.can.interface import QUEUED_MAX

Apply = Callable[[], None]
"""What a row of frames does to its drive."""


class VirtualBus:
    """Carries a row of frames at once while a node acknowledges it; otherwise the row waits.

    Attributes:
        acknowledged: True while some node is there.
        choked: True while frames of others fill the send queue: it takes none of ours.
        ages_ns: of each row that waited and reached its drive then.
        thrown_away: how many rows waited and were thrown away.
    """

    def __init__(self, bank: AxisBank, axes: Sequence[int]) -> None:
        """Take the drives, and the axes (0 .. 11) on this bus."""
        self.acknowledged, self.choked = True, False
        self.thrown_away = 0
        self.ages_ns: list[int] = []
        self._conditions, self._axes = bank.conditions, frozenset(axes)
        self._waiting: list[tuple[int, Apply]] = []

    def advance(self, now_ns: int) -> None:
        """See who is there; hand on what waits if anybody is."""
        conditions = self._conditions
        deaf = conditions.silent | conditions.deaf
        self.acknowledged = not (deaf and deaf.issuperset(self._axes))
        self.choked = not conditions.choked.isdisjoint(self._axes)
        if self._waiting and self.acknowledged:
            waiting, self._waiting = self._waiting, []
            for sent_ns, apply in waiting:
                self.ages_ns.append(now_ns - sent_ns)
                apply()

    def put(self, now_ns: int, apply: Apply) -> None:
        """Send a row; one that the socket has no room for is dropped."""
        if self.acknowledged:
            apply()
        elif len(self._waiting) < QUEUED_MAX:
            self._waiting.append((now_ns, apply))

    @property
    def waiting(self) -> int:
        """How many rows wait."""
        return len(self._waiting)

    def restart(self) -> None:
        """Throw away what waits."""
        self.thrown_away += len(self._waiting)
        self._waiting.clear()
