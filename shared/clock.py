"""The monotonic clock, in one place so that laws never read it."""

from __future__ import annotations

import time

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


def now_ns() -> int:
    """Return CLOCK_MONOTONIC in ns: one clock for all processes of one host."""
    return time.monotonic_ns()


def sleep_until(deadline_ns: int) -> None:
    """Sleep until a moment of the monotonic clock; return at once if it has passed."""
    remaining_ns = deadline_ns - time.monotonic_ns()
    if remaining_ns > 0:
        time.sleep(remaining_ns / NS_PER_S)
