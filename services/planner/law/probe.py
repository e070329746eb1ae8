"""Small known offsets of one row of the pose's reference, to measure how the robot answers. Pure.

`xrl drive tune` asks for them (`operator/intent`). The offset is added to the reference, within
`law.probe_max`, no faster than `PROBE_S` from the middle to the end of its range, and without a
rate of its own: damping acts on the robot's motion alone. A probe ends when its intent is stale.

A row that the person leads is held where it is while it is probed, on local gains. The hold begins
only at rest, and fades in and out during `HOLD_S`: at once it would be a step in torque (measured:
11 N m at a knee with the torso at 0.3 m/s), which the joint services refuse.

    p_ref    = p_C + offset                                a closed row
    p_ref    = p + hold (held - p) + offset                a row that is led
    pdot_ref = (1 - hold) pdot
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from shared.arrays import Array
from shared.clamp import clamp

NO_ROW: Final = -1
PROBE_S: Final = 0.04
"""Shortest time from the middle to the end of the range, s: ten ticks, so that no tick's torque
steps by more than the joint services accept."""
HOLD_S: Final = 0.5
"""Time in which the hold of a led row fades in, and out, s."""
STILL: Final = 0.02
"""m/s or rad/s; a led row that moves faster is not taken from the person."""


class ProbeState(msgspec.Struct, array_like=True):
    """State of `ReferenceProbe`."""

    row: int = NO_ROW
    """The coordinate of p that is probed; `NO_ROW`: none."""
    offset: float = 0.0
    """m or rad"""
    held: float = 0.0
    """Where a led row is held, m or rad."""
    hold: float = 0.0
    """How much it is, 0 .. 1."""


class ReferenceProbe:
    """Offset of one row."""

    def __init__(self, probe_max: Sequence[float], led: Sequence[float]) -> None:
        """Set the limits.

        Args:
            probe_max: largest offset of each row of p either way, m and rad; 0: never.
            led: `law.S`; 1 for a row that the person leads.
        """
        self._most, self._led = tuple(probe_max), tuple(bool(one) for one in led)
        self.state = ProbeState()

    def advance(self, row: int, wanted: float, p: Array, pdot: Array, dt: float) -> None:
        """Follow what is asked for; another row begins when this one is given back.

        Args:
            row: asked for; `NO_ROW`: none.
            wanted: its offset, m or rad; clipped to the limit.
            p: measured pose (6,).
            pdot: its rate (6,).
            dt: time since the last tick, s.
        """
        s = self.state
        if s.row == NO_ROW and row != NO_ROW and self._may_begin(row, float(pdot[row])):
            s.row, s.held = row, float(p[row])
        if s.row == NO_ROW:
            return
        is_asked, led, most = row == s.row, self._led[s.row], self._most[s.row]
        # a led row is held before it is offset, and offset no more before it is given back
        ready = is_asked and (not led or s.hold == 1.0)
        target = clamp(wanted, -most, most) if ready else 0.0
        step = dt * most / PROBE_S
        s.offset += clamp(target - s.offset, -step, step)
        if led and is_asked:
            s.hold = min(1.0, s.hold + dt / HOLD_S)
        elif s.offset == 0.0:
            s.hold = max(0.0, s.hold - dt / HOLD_S)
        if not is_asked and s.offset == 0.0 and s.hold == 0.0:
            s.row = NO_ROW

    def apply(self, p_ref: Array, pdot_ref: Array, p: Array, pdot: Array) -> None:
        """Offset the row of a reference p_ref (6,) and hold it, if it is led; rates pdot_ref."""
        s, row = self.state, self.state.row
        if row == NO_ROW:
            return
        if self._led[row]:
            p_ref[row] = p[row] + s.hold * (s.held - p[row])
            pdot_ref[row] = (1.0 - s.hold) * pdot[row]
        p_ref[row] += s.offset

    def reset(self) -> None:
        """End at once: the planner does not lead."""
        s = self.state
        s.row, s.offset, s.hold = NO_ROW, 0.0, 0.0

    def _may_begin(self, row: int, rate: float) -> bool:
        return self._most[row] > 0.0 and (not self._led[row] or abs(rate) < STILL)
