"""The loop of a service that reads a sensor: cycles on a grid of periods."""

from __future__ import annotations

from typing import Protocol

from shared.clock import NS_PER_S, now_ns, sleep_until


class Loop(Protocol):
    """What runs at a rate."""

    skipped: int
    """Deadlines that were missed and not made up for."""

    def cycle(self, now_ns: int, /) -> object:
        """Run once."""


class Stop(Protocol):
    """Something that becomes true when the loop is to end."""

    def __bool__(self) -> bool:
        """Return True to stop."""


def next_deadline(deadline_ns: int, period_ns: int, now_ns: int) -> tuple[int, int]:
    """Return the next deadline after now on the grid of periods, and how many were missed."""
    missed = max(0, (now_ns - deadline_ns) // period_ns)
    return deadline_ns + (missed + 1) * period_ns, missed


def run(loop: Loop, rate_hz: float, stop: Stop) -> None:
    """Run cycles at `rate_hz` until stopped; missed cycles are skipped."""
    period_ns = round(NS_PER_S / rate_hz)
    deadline_ns = now_ns()
    while not stop:
        loop.cycle(now_ns())
        deadline_ns, missed = next_deadline(deadline_ns, period_ns, now_ns())
        loop.skipped += missed
        sleep_until(deadline_ns)
