"""Small known offsets of one row of the pose's reference, to measure how the robot answers. Pure.

`xrl tune` asks for them (`operator/intent`). The offset is added to the reference, within
`law.probe_max`, no faster than `PROBE_S` for the whole range, and without a rate of its own:
damping acts on the robot's motion alone. A row that the person leads is held where it is while it
is probed, on local gains. A probe that is not repeated ends at once.

    p_ref = p_C + offset                  a closed row
    p_ref = p at the probe's begin + offset    a row that is led
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NO_ROW: Final = -1
PROBE_S: Final = 0.04
"""Shortest time from the middle to the end of the range, s: ten ticks, so that no tick's torque
steps by more than the joint services accept."""


class ProbeState(NamedTuple):
    """State of `ReferenceProbe`."""

    row: int = NO_ROW
    offset: float = 0.0
    held: float = 0.0


class ReferenceProbe:
    """Offset of one row.

    Attributes:
        row: of p that is probed; `NO_ROW`: none.
        offset: m or rad.
        held: the row's place when the probe began, m or rad.
    """

    def __init__(self, probe_max: Sequence[float]) -> None:
        """Set the largest offset of each row of p either way, m and rad; 0: never."""
        self._most = tuple(probe_max)
        self.row, self.offset, self.held = NO_ROW, 0.0, 0.0

    def advance(self, row: int, wanted: float, p: Array, dt: float) -> None:
        """Follow what is asked for; another row begins when this one's offset is back at 0.

        Args:
            row: asked for; `NO_ROW`: none.
            wanted: its offset, m or rad; clipped to the limit.
            p: measured pose (6,).
            dt: time since the last tick, s.
        """
        if self.row == NO_ROW and row != NO_ROW and self._most[row] > 0.0:
            self.row, self.held = row, float(p[row])
        if self.row == NO_ROW:
            return
        most = self._most[self.row]
        target = min(most, max(-most, wanted)) if row == self.row else 0.0
        step = dt * most / PROBE_S
        self.offset += min(step, max(-step, target - self.offset))
        if row != self.row and self.offset == 0.0:
            self.row = NO_ROW

    def reset(self) -> None:
        """End at once: the planner does not lead."""
        self.row, self.offset = NO_ROW, 0.0

    def snapshot(self) -> ProbeState:
        """Return the state."""
        return ProbeState(self.row, self.offset, self.held)

    def restore(self, state: ProbeState) -> None:
        """Continue from a state."""
        self.row, self.offset, self.held = state
