"""What is done to links at the moment, and until when; told as events. Pure.

Lockstep and the injector both keep it so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from shared.impairment import Direction, Impairer, Impairment
from shared.links import directions_of
from shared.traces import LinkEvent


class InForce(NamedTuple):
    """One impairment that is not over."""

    until: float
    """On the owner's clock; infinite: it does not end by itself."""
    link: str
    """A direction or a group of them."""
    what: Impairment


class Injections:
    """All of them, by number."""

    def __init__(
        self, directions: Mapping[str, Direction], tell: Callable[[LinkEvent], object]
    ) -> None:
        """Begin with none.

        Args:
            directions: every one, by name.
            tell: takes an event for each direction whenever something begins or ends.
        """
        self.asked: dict[int, InForce] = {}
        self.next_end = math.inf
        """When the first of them ends, on the owner's clock."""
        self._directions = directions
        self._tell = tell
        self._count = self._told = 0

    def begin(self, link: str, what: Impairment, until: float, now_ns: int) -> int:
        """Put an impairment in force; return its number.

        Args:
            link: of `shared.links`.
            what: is done.
            until: when it ends, on the owner's clock.
            now_ns: stamp of the events.

        Raises:
            ConfigError: there is no such link.
        """
        names = directions_of(link)
        self._count += 1
        self.asked[self._count] = InForce(until, link, what)
        for name in names:
            self._directions[name].begin(self._count, what)
            self._say(name, self._count, self.asked[self._count], now_ns, None)
        self._find_next()
        return self._count

    def end(self, number: int, now_ns: int) -> None:
        """End one; nothing if it is over already."""
        asked = self.asked.pop(number, None)
        if asked is None:
            return
        for name in directions_of(asked.link):
            impairer = self._directions[name].end(number)
            if impairer is not None:
                self._say(name, number, asked, now_ns, impairer)
        self._find_next()

    def end_due(self, clock: float, now_ns: int) -> bool:
        """End those whose time is over by the owner's clock; return whether there were any."""
        if clock < self.next_end:
            return False
        for number in [n for n, asked in self.asked.items() if asked.until <= clock]:
            self.end(number, now_ns)
        return True

    def clear(self, link: str, now_ns: int) -> int:
        """End all that touches a link, wholly; return how many.

        Raises:
            ConfigError: there is no such link.
        """
        names = set(directions_of(link))
        found = [n for n, asked in self.asked.items() if names & set(directions_of(asked.link))]
        for number in found:
            self.end(number, now_ns)
        return len(found)

    def counts(self, number: int) -> tuple[int, int]:
        """Return the messages that have passed, and that were lost, under one of them."""
        found = [direction.asked(number) for direction in self._directions.values()]
        counted = [impairer for impairer in found if impairer is not None]
        return sum(one.passed for one in counted), sum(one.lost for one in counted)

    def _find_next(self) -> None:
        self.next_end = min((asked.until for asked in self.asked.values()), default=math.inf)

    def _say(
        self, name: str, number: int, asked: InForce, now_ns: int, ended: Impairer | None
    ) -> None:
        self._told += 1
        what = asked.what
        self._tell(
            LinkEvent(
                t_ns=now_ns,
                seq=self._told,
                link=name,
                asked=asked.link,
                number=number,
                in_force=ended is None,
                delay_ms=what.delay_ms,
                jitter_ms=what.jitter_ms,
                loss=what.loss,
                partition=what.partition,
                detail=what.in_words(),
                passed=0 if ended is None else ended.passed,
                lost=0 if ended is None else ended.lost,
            )
        )
