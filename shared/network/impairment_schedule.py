"""Schedule of a network's impairments; each change is reported as an event. Pure.

Lockstep and the network proxy use it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from shared.bus.traces import LinkEvent
from shared.config.impairment import Direction, Impairer, Impairment
from shared.links import directions_of


class _Pending(NamedTuple):
    """One impairment that is not over, started or not."""

    begins: float
    """Start on the owner's clock; minus infinity: at once."""
    until: float
    """End on the owner's clock; infinity: no end."""
    link: str
    """A direction or a group of them."""
    what: Impairment


class ImpairmentSchedule:
    """All impairments by number; `report` receives an event per direction at each start and end.

    Times are on the owner's clock; `now_ns` is the events' time stamp. Raises ConfigError for a
    link that is not in `shared.links`.
    """

    def __init__(
        self, directions: Mapping[str, Direction], report: Callable[[LinkEvent], object]
    ) -> None:
        self.requested: dict[int, _Pending] = {}
        self.next_due = math.inf
        """Time of the next start or end, on the owner's clock."""
        self._directions = directions
        self._report = report
        self._coming: list[int] = []
        """Impairments that have not started, in the order of the requests."""
        self._count = self._reported = 0

    def begin(self, link: str, what: Impairment, until: float, now_ns: int) -> int:
        """Start an impairment now; return its number."""
        number = self.plan(link, what, -math.inf, until)
        self._begin(number, now_ns)
        self._find_next()
        return number

    def plan(self, link: str, what: Impairment, begins: float, until: float) -> int:
        """Plan an impairment that `advance` starts when it is due; return its number."""
        directions_of(link)
        self._count += 1
        self.requested[self._count] = _Pending(begins, until, link, what)
        self._coming.append(self._count)
        self._find_next()
        return self._count

    def end(self, number: int, now_ns: int) -> None:
        """End an impairment or cancel its start; no effect if it is over."""
        requested = self.requested.pop(number, None)
        if requested is None:
            return
        if number in self._coming:
            self._coming.remove(number)
        for name in directions_of(requested.link):
            impairer = self._directions[name].end(number)
            if impairer is not None:
                self._describe(name, number, requested, now_ns, impairer)
        self._find_next()

    def advance(self, clock: float, now_ns: int) -> bool:
        """End and start the impairments that are due; return True if any was due.

        `clock` is the time on the owner's clock. An impairment whose end has passed does not start.
        """
        if clock < self.next_due:
            return False
        for number in [n for n, requested in self.requested.items() if requested.until <= clock]:
            self.end(number, now_ns)
        due = [number for number in self._coming if self.requested[number].begins <= clock]
        for number in sorted(due, key=lambda number: self.requested[number].begins):
            self._begin(number, now_ns)
        self._find_next()
        return True

    def clear(self, link: str, now_ns: int) -> int:
        """End all impairments that affect a link, started or not; return their number."""
        names = set(directions_of(link))
        found = [n for n, row in self.requested.items() if names & set(directions_of(row.link))]
        for number in found:
            self.end(number, now_ns)
        return len(found)

    def counts(self, number: int) -> tuple[int, int]:
        """Return (passed, lost), the numbers of messages while an impairment was active."""
        found = [direction.requested(number) for direction in self._directions.values()]
        counted = [impairer for impairer in found if impairer is not None]
        return sum(one.passed for one in counted), sum(one.lost for one in counted)

    def hidden(self, number: int) -> tuple[str, ...]:
        """Return the directions on which another impairment is active in place of this one."""
        found = []
        for name, direction in self._directions.items():
            impairer = direction.requested(number)
            if impairer is not None and impairer is not direction.active:
                found.append(name)
        return tuple(found)

    def _begin(self, number: int, now_ns: int) -> None:
        self._coming.remove(number)
        requested = self.requested[number]
        for name in directions_of(requested.link):
            self._directions[name].begin(number, requested.what)
            self._describe(name, number, requested, now_ns, None)

    def _find_next(self) -> None:
        times = [requested.until for requested in self.requested.values()]
        times += [self.requested[number].begins for number in self._coming]
        self.next_due = min(times, default=math.inf)

    def _describe(
        self,
        name: str,
        number: int,
        requested: _Pending,
        now_ns: int,
        ended: Impairer | None,
    ) -> None:
        self._reported += 1
        what = requested.what
        self._report(
            LinkEvent(
                t_ns=now_ns,
                seq=self._reported,
                link=name,
                requested=requested.link,
                number=number,
                active=ended is None,
                delay_ms=what.delay_ms,
                jitter_ms=what.jitter_ms,
                loss=what.loss,
                partition=what.partition,
                detail=what.describe(),
                passed=0 if ended is None else ended.passed,
                lost=0 if ended is None else ended.lost,
            )
        )
