"""The links of lockstep, and what a scenario does to them (design section 7)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from shared.impairment import Impairer, Impairment
from shared.joints import MODULES
from shared.links import DIRECTIONS, WRENCHES, directions_of
from shared.messages import JointCommand, JointState, LinkEvent, Wrench
from shared.scenario import Inject
from tools.runs.network import Link


class _Asked(NamedTuple):
    """One `Inject` that is in force."""

    until: float
    """Scenario time, s."""
    number: int
    what: Inject


class VirtualNetwork:
    """Every link, by direction."""

    def __init__(
        self,
        base: Impairment,
        injects: Sequence[Inject],
        seed: int,
        record: Callable[[LinkEvent], None],
    ) -> None:
        """Begin with what every link does by itself.

        Args:
            base: that.
            injects: what is done to them, and when.
            seed: of all that is decided.
            record: takes an event whenever something begins or ends.
        """
        self._links: dict[str, Link[Any]] = {name: Link(base, name, seed) for name in DIRECTIONS}
        self._coming = sorted(enumerate(injects, 1), key=lambda row: row[1].at)
        self._lasting: list[_Asked] = []
        self._record = record
        self._said = 0
        self._next_s = self._next()

    def commands(self) -> list[Link[JointCommand]]:
        """Return the links from the planner, in the order of the modules."""
        return [self._links[f"planner->{module}"] for module in MODULES]

    def states(self) -> list[Link[JointState]]:
        """Return the links to the planner, in the order of the modules."""
        return [self._links[f"{module}->planner"] for module in MODULES]

    def wrenches(self) -> Link[Wrench]:
        """Return the link from the harness to the planner."""
        return self._links[WRENCHES]

    def advance(self, scenario_s: float, now_ns: int) -> None:
        """Begin and end what is due."""
        if scenario_s < self._next_s:
            return
        for asked in [row for row in self._lasting if row.until <= scenario_s]:
            self._lasting.remove(asked)
            for name in directions_of(asked.what.link):
                link = self._links[name]
                impairer = link.direction.end(asked.number)
                link.release(now_ns)
                self._say(now_ns, name, asked.what, impairer)
        while self._coming and self._coming[0][1].at <= scenario_s:
            number, what = self._coming.pop(0)
            if what.until > scenario_s:
                self._lasting.append(_Asked(what.until, number, what))
                for name in directions_of(what.link):
                    self._links[name].direction.begin(number, what)
                    self._links[name].release(now_ns)
                    self._say(now_ns, name, what, None)
        self._next_s = self._next()

    def _next(self) -> float:
        """Return when something is due, scenario time, s."""
        times = [row.until for row in self._lasting] + [row.at for _, row in self._coming]
        return min(times, default=math.inf)

    def _say(self, now_ns: int, name: str, what: Inject, ended: Impairer | None) -> None:
        self._said += 1
        self._record(link_event(now_ns, self._said, name, what, ended))


def link_event(
    now_ns: int, seq: int, name: str, what: Impairment, ended: Impairer | None
) -> LinkEvent:
    """Return what the log says of an impairment that begins, or with `ended` has ended."""
    return LinkEvent(
        t_ns=now_ns,
        seq=seq,
        link=name,
        in_force=ended is None,
        delay_ms=what.delay_ms,
        jitter_ms=what.jitter_ms,
        loss=what.loss,
        partition=what.partition,
        detail=what.in_words(),
        passed=0 if ended is None else ended.passed,
        lost=0 if ended is None else ended.lost,
    )
