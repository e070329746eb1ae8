"""Stalls: times in which the machine ran nothing. The verdict excludes their consequences.

A module that gets no command in time holds, as it should. One timer thread measures stalls during
a live run. The status line, picture and verdict show them, the latter two from the record's events.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from shared.bus.messages import Cause, JointEvent, Mode, RunEvent, RunEventKind
from shared.clock import NS_PER_MS, NS_PER_S, pace

MACHINE: Final = "the machine"
PERIOD_NS: Final = 4 * NS_PER_MS
GAP_NS: Final = 20 * NS_PER_MS
"""Minimum delay of a stall, beyond the period. Together with the network's delay it can make
commands 50 ms old."""
PRIORITY: Final = 30
"""Real-time priority above every service's, and within the limit in docs/bring-up.md."""
LASTED_MAX_MS: Final = 1e9
DROP_OUT_NS: Final = 150 * NS_PER_MS
"""Time after a stall within which a dropout because of old commands is attributed to the stall."""
EXCUSE_MIN_MS: Final = 30.0
"""A shorter stall alone makes no command 50 ms old: most commands are about 10 ms old when used."""
APART_NS: Final = 3 * NS_PER_S
"""Time after a stall that led and held figures exclude: modules return to TRACK, and the robot
catches up with the hand."""
STALL_SHOWN_NS: Final = 2 * NS_PER_S
"""Time for which a display shows a stall."""


class Stall(NamedTuple):
    """Time in which the machine ran nothing, on the monotonic clock of messages."""

    begin_ns: int
    end_ns: int

    @property
    def lasted_ms(self) -> float:
        """Its length, ms."""
        return (self.end_ns - self.begin_ns) / NS_PER_MS

    @property
    def words(self) -> str:
        """Text for a display."""
        return f"{MACHINE} stalled for {self.lasted_ms:.0f} ms"

    def event(self, seq: int, scenario_zero_ns: int) -> RunEvent:
        """Return the event that `stalls_of` reads."""
        return RunEvent(
            t_ns=self.end_ns, seq=seq, kind=int(RunEventKind.STALLED), subject=MACHINE,
            detail=f"{self.lasted_ms:.1f} ms",
            scenario_s=(self.begin_ns - scenario_zero_ns) / NS_PER_S,
        )  # fmt: skip


def stalls_of(events: Iterable[RunEvent]) -> list[Stall]:
    """Return the stalls among a run's events; malformed events are ignored."""
    found = []
    for event in events:
        with suppress(ValueError):  # the event was written by hand
            if event.kind == RunEventKind.STALLED:
                lasted_ms = float(event.detail.removesuffix(" ms"))
                if 0.0 < lasted_ms < LASTED_MAX_MS:
                    found.append(Stall(event.t_ns - round(lasted_ms * NS_PER_MS), event.t_ns))
    return sorted(found)


class Disturbance(NamedTuple):
    """A stall, the end of the time that led and held figures exclude, and the modules in HOLD."""

    stall: Stall
    end_ns: int
    held: int


def disturbances(
    events: Sequence[RunEvent], changes: Sequence[JointEvent], end_ns: int
) -> list[Disturbance]:
    """Return the effect of each stall that begins by `end_ns`.

    `changes` are the mode changes of all modules. A HOLD after a kill or a fault is not attributed
    to a stall: the kill or fault may have caused it.
    """
    own, by_it = (RunEventKind.KILLED, RunEventKind.FAULTED), (Cause.COMMAND_STALE, Cause.HOLD_ALL)
    limit_ns = min([row.t_ns for row in events if row.kind in own] + [end_ns])
    drop_outs = [row for row in changes if goes_to_hold(row) and row.cause in by_it]
    found = []
    for stall in stalls_of(events):
        last_ns = min(stall.end_ns + DROP_OUT_NS, limit_ns)
        causes = [row.cause for row in drop_outs if stall.begin_ns <= row.t_ns < last_ns]
        is_long = Cause.COMMAND_STALE in causes and stall.lasted_ms >= EXCUSE_MIN_MS
        held = len(causes) if is_long else 0
        apart_ns = min(stall.end_ns + APART_NS, limit_ns) if held else stall.end_ns + PERIOD_NS
        if stall.begin_ns <= end_ns:
            found.append(Disturbance(stall, apart_ns, held))
    return found


def goes_to_hold(row: JointEvent) -> bool:
    """Return True for a dropout: the module tracked, and now holds."""
    return row.mode_before == Mode.TRACK and row.mode_after == Mode.HOLD


def inside(rows: Iterable[Disturbance], times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for each time whether led and held figures exclude it."""
    mask = np.zeros(len(times_ns), dtype=bool)
    for row in rows:
        mask |= (times_ns >= row.stall.begin_ns) & (times_ns <= row.end_ns)
    return mask


class StallWatch:
    """A timer thread beside a fleet, with real-time priority if permitted."""

    def __init__(self) -> None:
        self.longest = Stall(0, 0)
        """Longest recent stall; (0, 0) before the first."""
        self.held = 0
        """Largest number of modules in HOLD at once since that stall."""
        self._gaps: deque[tuple[int, int]] = deque()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="stalls", daemon=True)

    def __enter__(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread."""
        self._over.set()
        self._thread.join()

    def take(self) -> list[Stall]:
        """Return the stalls since the last call, by the fleet's clock."""
        rate, gaps = pace(), [self._gaps.popleft() for _ in range(len(self._gaps))]
        found = [Stall(int(rate * begin_ns), int(rate * end_ns)) for begin_ns, end_ns in gaps]
        found = [stall for stall in found if stall.end_ns - stall.begin_ns > GAP_NS]
        for stall in found:
            if not self.is_recent(stall.end_ns) or stall.lasted_ms >= self.longest.lasted_ms:
                self.longest, self.held = stall, 0
        return found

    def is_recent(self, now_ns: int) -> bool:
        """Return True if the longest stall must still be shown."""
        return self.longest.end_ns > 0 and now_ns - self.longest.end_ns <= STALL_SHOWN_NS

    def note_held(self, count: int) -> None:
        """Record how many modules are in HOLD now."""
        self.held = max(self.held, count)

    def _watch(self) -> None:
        with suppress(PermissionError):  # priority of this thread only
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        last_ns = time.monotonic_ns()
        while not self._over.is_set():
            time.sleep(PERIOD_NS / NS_PER_S)
            now_ns = time.monotonic_ns()
            if now_ns - last_ns - PERIOD_NS > GAP_NS:
                self._gaps.append((last_ns + PERIOD_NS, now_ns))
            last_ns = now_ns
