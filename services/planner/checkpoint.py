"""When the planner's memory is written down, so that it can be executed again from there. Pure."""

from __future__ import annotations

import msgspec

from services.planner.planner import Planner
from shared.bus.traces import PlannerCheckpoint


class Checkpoints:
    """Counts ticks: the memory after each that is a power of two, then after one a second.

    Often at first, for a recorder hears a new planner a moment late.
    """

    def __init__(self, rate_hz: float) -> None:
        """Take the planner's rate."""
        self._every = round(rate_hz)
        self._tick = 0
        self._seq = 0
        self._encode = msgspec.json.Encoder().encode

    def after(self, planner: Planner, now_ns: int) -> PlannerCheckpoint | None:
        """Return the memory after the tick that has been, if it is time to write it."""
        self._tick += 1
        tick = self._tick
        first = tick < self._every and tick & (tick - 1) == 0
        if not first and tick % self._every:
            return None
        self._seq += 1
        return PlannerCheckpoint(
            t_ns=now_ns,
            seq=self._seq,
            session=planner.session,
            snapshot=self._encode(planner.snapshot()).decode(),
        )
