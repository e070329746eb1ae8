"""Stalls of a live run, as they come: found, and shown for some moments."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from shared.bus.messages import JointState, Mode, SimTruth
from shared.clock import now_ns, pace
from shared.robot.joints import MODULES
from tools.fleet.stall_watch import Gap, StallWatch
from tools.runs.stalls import STALL_SHOWN_NS, Stall, StallFinder


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
        """Return what to show of the newest stall; empty if it was a while ago.

        Args:
            modes: of the modules that are heard; none where they hold for another reason.
        """
        if not self.found or now_ns() - self.found[-1].end_ns > STALL_SHOWN_NS:
            return ""
        held = modes.count(Mode.HOLD)
        self._held = max(self._held, held)
        if not self._held:
            return self.found[-1].words
        who = "all six" if self._held == len(MODULES) else self._held
        return f"{self.found[-1].words}: {who} {'hold' if held else 'held'}"

    def describe_machine(self, idle: float, least: float) -> str:
        """Return how the machine carries the fleet.

        Args:
            idle: fraction of all cores' time, beside the fleet.
            least: below it the cores count as full.
        """
        words = f"{self.cores} cores, {100 * idle:.0f} % idle beside the fleet"
        if idle < least:
            words += f": too little, modules may hold; `--pace {pace() / 2:g}` asks for half of it"
        if not self.found:
            return words
        most_ms = max(stall.lasted_ms for stall in self.found)
        so_far = f"{len(self.found)} stall{'s' * (len(self.found) > 1)} so far"
        return f"{words}; {so_far}, {most_ms:.0f} ms at most"

    def _gaps(self) -> list[Gap]:
        return self._watch.take() if self._watch is not None else []
