"""Decides when the planner's state is recorded, so that re-execution can start from it. Pure."""

from __future__ import annotations

import msgspec

from services.planner.planner import Planner
from shared.bus.traces import PlannerCheckpoint


class Checkpoints:
    """Counts ticks; due after every tick number that is a power of two, then once a second.

    It is frequent at first, because a recorder discovers a new planner with a short delay.
    """

    def __init__(self, rate_hz: float) -> None:
        """Set the planner's rate, Hz."""
        self._every = round(rate_hz)
        self._tick = 0
        self._seq = 0
        self._encode = msgspec.json.Encoder().encode

    def after(self, planner: Planner, now_ns: int) -> PlannerCheckpoint | None:
        """Return the state after the tick just run, if it is due."""
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
