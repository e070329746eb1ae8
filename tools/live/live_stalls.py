"""Stalls of a live run: found as they come, and shown for some moments."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from services.joint.loop import READ_TIMEOUT_S
from shared import scheduling
from shared.bus import topics
from shared.bus.messages import JointState, Mode
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S, now_ns, pace
from shared.joints import MODULES
from tools.fleet.stall_watch import ANY_CORE, GAP_NS, UNSURE, Gap, StallWatch
from tools.judge.stalls import ALL, MACHINE, SERVICES, SIMULATOR, STALL_SHOWN_NS, Stall

A_THREAD: Final = "a thread"
CYCLE_MAX_NS: Final = round(READ_TIMEOUT_S * NS_PER_S)
"""Longest cycle of a joint service that runs: its drive is silent."""
TRUTH_NS: Final = round(NS_PER_S / topics.SIM_TRUTH.rate_hz)
ALIVE_NS: Final = NS_PER_S
"""A module that was silent for longer before a stall has no part in it."""
MERGE_NS: Final = 50 * NS_PER_MS
"""Two ways of finding one stall report it within this time of each other."""
FULL_CORE: Final = 0.2
"""With less idle time beside the fleet one of two cores may be full; of four it fills none."""


class Silence:
    """Finds when one sender stood still, from those of its messages that are seen.

    Each message has a count that grows while the sender runs; how much it grew between two messages
    tells for how long the sender ran in between.
    """

    def __init__(self, step_ns: int) -> None:
        """Take the longest time in which the count of a sender that runs grows by one."""
        self._step_ns = step_ns
        self.last_ns, self._count = -1, -1
        self._silent_in_a_row = 0

    @property
    def is_slow(self) -> bool:
        """True if one silence follows the other: it is its pace, and no stall."""
        return self._silent_in_a_row > 1

    def feed(self, t_ns: int, count: int) -> tuple[int, int] | None:
        """Return begin and end of the silence before a message, if it is a stall."""
        if t_ns == self.last_ns:  # a stamp that is repeated
            return None
        last_ns, steps = self.last_ns, count - self._count
        self.last_ns, self._count = t_ns, count
        silent_ns = t_ns - last_ns - (steps - 1) * self._step_ns
        if last_ns < 0 or steps < 0 or silent_ns <= self._step_ns + GAP_NS:
            self._silent_in_a_row = 0
            return None
        self._silent_in_a_row += 1
        return last_ns, last_ns + silent_ns


class CommonSilence:
    """Finds when every joint service that was alive stood still.

    By its cycles: its states repeat the stamp of the last sample while a drive is silent.
    """

    def __init__(self) -> None:
        self._of: dict[str, Silence] = {}
        self._silent: dict[str, tuple[int, int]] = {}

    def feed(self, module: str, state: JointState) -> Stall | None:
        """Take a state; return the stall that it is the last to tell of."""
        own = self._of.setdefault(module, Silence(CYCLE_MAX_NS))
        silent = own.feed(state.t_ns, state.cycle)
        if silent is None:
            return None
        self._silent[module] = silent
        alive = [one for one, row in self._of.items() if row.last_ns > silent[0] - ALIVE_NS]
        if len(alive) < 2 or not self._silent.keys() >= set(alive):
            return None
        begin_ns = max(self._silent[one][0] for one in alive)
        end_ns = min(self._silent[one][1] for one in alive)
        if end_ns - begin_ns <= GAP_NS:
            return None
        self._silent.clear()
        return Stall(begin_ns, end_ns, SERVICES)


class StallFinder:
    """Finds the stalls of a live run, each once, whatever shows it."""

    def __init__(self, cores: int, gaps: Callable[[], Sequence[Gap]]) -> None:
        """Take how many threads watch a core of their own, and what gives their new gaps."""
        self._cores, self._gaps = cores, gaps
        self._services, self._world = CommonSilence(), Silence(TRUTH_NS)
        self._pending: list[Stall] = []

    def hear(self, module: str, state: JointState) -> None:
        """Take a state of a module."""
        stall = self._services.feed(module, state)
        if stall is not None:
            self._pending.append(stall)

    def see(self, truth: SimTruth) -> None:
        """Take a state of the simulated world."""
        silent = self._world.feed(truth.t_ns, truth.seq)
        if silent is not None and not self._world.is_slow:
            self._pending.append(Stall(*silent, SIMULATOR))

    def take(self, now_ns: int, pace: float) -> list[Stall]:
        """Return what has ended some moments ago and was not returned before, in order.

        Args:
            now_ns: fleet's clock.
            pace: its rate beside CLOCK_MONOTONIC.
        """
        for gap in self._gaps():
            end_ns, lasted_ns = int(pace * gap.end_ns), int(pace * gap.lasted_ns)
            who = {ANY_CORE: MACHINE, UNSURE: A_THREAD}.get(gap.core, f"core {gap.core}")
            stolen_ms = pace * gap.stolen_ns / NS_PER_MS
            self._pending.append(Stall(end_ns - lasted_ns, end_ns, who, stolen_ms))
        groups = _overlapping(self._pending)
        done = [group for group in groups if now_ns >= MERGE_NS + max(row.end_ns for row in group)]
        self._pending = [row for group in groups if group not in done for row in group]
        return merged([row for group in done for row in group], self._cores)

    def rest(self) -> list[Stall]:
        """Return what no other way of finding it can add to any more: the run is over."""
        found, self._pending = merged(self._pending, self._cores), []
        return found


def merged(stalls: Iterable[Stall], cores: int) -> list[Stall]:
    """Return stalls that overlap as one, of all that stood still.

    What a thread without real time saw alone is left out.
    """
    found = (_joined(group, cores) for group in _overlapping(stalls))
    return [stall for stall in found if stall.who != A_THREAD]


def _overlapping(stalls: Iterable[Stall]) -> list[list[Stall]]:
    groups: list[list[Stall]] = []
    end_ns = -1
    for stall in sorted(stalls):
        if stall.begin_ns > end_ns:
            groups.append([])
            end_ns = stall.end_ns
        groups[-1].append(stall)
        end_ns = max(end_ns, stall.end_ns)
    return groups


def _joined(group: Sequence[Stall], cores: int) -> Stall:
    names = {row.who for row in group}
    numbers = sorted(int(name.removeprefix("core ")) for name in names if name.startswith("core "))
    on_cores = [row for row in group if row.who.startswith("core ")]
    together = on_cores and max(r.begin_ns for r in on_cores) < min(r.end_ns for r in on_cores)
    if MACHINE in names or (len(numbers) >= cores and together):
        who = MACHINE
    elif numbers:
        who = f"core{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"
    elif {SERVICES, SIMULATOR} <= names:
        who = ALL
    else:
        who = next(name for name in (SERVICES, SIMULATOR, A_THREAD) if name in names)
    return Stall(
        min(row.begin_ns for row in group),
        max(row.end_ns for row in group),
        who,
        max(row.stolen_ms for row in group),
    )


class LiveStalls:
    """Finds stalls while it watches.

    Attributes:
        found: all so far, in order.
    """

    def __init__(self) -> None:
        self.found: list[Stall] = []
        self.cores = len(os.sched_getaffinity(0))
        self._watch: StallWatch | None = None
        self._finder = StallFinder(self.cores, self._gaps)
        self._held = 0
        self._began_ns = 0

    @contextlib.contextmanager
    def watched(self, path: Path) -> Iterator[None]:
        """Watch the machine meanwhile; gaps go to a file that is made."""
        with StallWatch(path) as self._watch:
            yield

    def begin(self) -> None:
        """Find stalls from now on; services that start stand still for reasons of their own."""
        self._began_ns = self._began_ns or now_ns()

    def hear(self, module: str, state: JointState) -> None:
        """Take a state of a module."""
        if self._began_ns:
            self._finder.hear(module, state)

    def see(self, truth: SimTruth) -> None:
        """Take a state of the simulated world."""
        if self._began_ns:
            self._finder.see(truth)

    def take(self) -> list[Stall]:
        """Return what was found since the last call."""
        return self._kept(self._finder.take(now_ns(), pace()))

    def rest(self) -> list[Stall]:
        """Return what was found at the end of a run."""
        return self.take() + self._kept(self._finder.rest())

    def _kept(self, found: list[Stall]) -> list[Stall]:
        found = [stall for stall in found if 0 < self._began_ns <= stall.begin_ns]
        if found:
            self.found += found
            self._held = 0
        return found

    def words(self, modes: Sequence[int]) -> str:
        """Return what to show of the newest stall; empty if it was a while ago."""
        if not self.found or now_ns() - self.found[-1].end_ns > STALL_SHOWN_NS:
            return ""
        held = modes.count(Mode.HOLD)
        self._held = max(self._held, held)
        if not self._held:
            return self.found[-1].words
        who = "all six" if self._held == len(MODULES) else self._held
        return f"{self.found[-1].words}: {who} {'hold' if held else 'held'}"

    def describe_machine(self, idle: float) -> str:
        """Return how the machine carries the fleet."""
        words = f"{self.cores} cores, {100 * idle:.0f} % idle beside the fleet"
        pause_ms = self._pause_ms() if idle < FULL_CORE else 0.0
        if pause_ms:
            words += (
                f"; a core that it fills the kernel stops for {pause_ms:g} ms in each second: "
                f"`sudo sysctl {scheduling.NO_PAUSE}`"
            )
        if not self.found:
            return words
        most_ms = max(stall.lasted_ms for stall in self.found)
        so_far = f"{len(self.found)} stall{'s' * (len(self.found) > 1)} so far"
        return f"{words}; {so_far}, {most_ms:.0f} ms at most"

    def _pause_ms(self) -> float:
        """Return how long the kernel stops processes that fill a core, ms; 0: it does not."""
        real_time = self._watch is not None and scheduling.has_real_time(self._watch.pid)
        return scheduling.real_time_pause_ms() if real_time else 0.0

    def _gaps(self) -> list[Gap]:
        return self._watch.take() if self._watch is not None else []
