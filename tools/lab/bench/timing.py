"""Times a function warm and cold, by the wall and by the thread's CPU clock.

A loop that calls a function a thousand times in a row finds its code and data in the cache. In the
fleet each cycle follows a sleep, and ten processes share two cores: a planner tick of 294 us warm
cost 568 us live. `cold` sweeps more memory than a core's own cache holds, and sleeps, before each
call; that reproduced the live figure.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec
import numpy as np

SWEPT_BYTES: Final = 6 << 20
"""Read and written before each cold call."""
ASLEEP_S: Final = 1.5e-3
"""Sleep before each cold call: most of a joint service's cycle."""
YARDSTICK_CALLS: Final = 20


class Repeated(NamedTuple):
    """Something to measure."""

    once: Callable[[], object]
    """The call that is timed."""
    before: Callable[[], object] | None = None
    """Prepares each call, untimed."""


class Spread(msgspec.Struct, frozen=True):
    """Percentiles of a time, us."""

    p10: float
    p50: float
    p90: float


class Cost(msgspec.Struct, frozen=True):
    """Cost of one call."""

    cpu: Spread
    """CPU time of the calling thread."""
    wall: Spread


def measure(repeated: Repeated, calls: int, *, cold: bool) -> Cost:
    """Return the cost of a call; `cold`: sweep the cache and sleep before each."""
    once, before = repeated.once, repeated.before
    swept = np.zeros(SWEPT_BYTES, dtype=np.uint8)
    cpu, wall = np.empty(calls), np.empty(calls)
    for call in range(calls):
        if before is not None:
            before()
        if cold:
            np.add(swept, 1, out=swept)
            time.sleep(ASLEEP_S)
        wall_ns, cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        once()
        cpu[call] = time.thread_time_ns() - cpu_ns
        wall[call] = time.perf_counter_ns() - wall_ns
    return Cost(_spread(cpu), _spread(wall))


def yardstick_us() -> float:
    """Return the least time of `YARDSTICK_CALLS` solutions of a 12 x 12 system, us."""
    A = np.eye(12) + 0.01 * np.arange(144.0).reshape(12, 12) / 144.0
    b = np.ones(12)

    def once() -> float:
        begin = time.perf_counter()
        for _ in range(YARDSTICK_CALLS):
            np.linalg.solve(A, b)
        return time.perf_counter() - begin

    return 1e6 * min(once() for _ in range(15))


def _spread(times_ns: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Spread:
    p10, p50, p90 = np.percentile(times_ns * 1e-3, [10, 50, 90]).tolist()
    return Spread(p10, p50, p90)
