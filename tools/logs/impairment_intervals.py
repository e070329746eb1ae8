"""Intervals in which a run's network was impaired, from the link events in its log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_S

LAST_NS: Final = np.iinfo(np.int64).max


class Impaired(NamedTuple):
    """One impairment, over all its directions."""

    link: str
    """A direction or a group of directions, as requested."""
    words: str
    """The impairment, in the format of `--inject`."""
    directions: frozenset[str]
    """Directions, as named in `shared.links`."""
    begin_ns: int
    """Monotonic clock of the messages."""
    end_ns: int | None
    """None if its end is not in the log."""
    passed: int | None
    """Messages that passed while it was active, in all directions; None without an end."""
    lost: int | None
    """Messages that it dropped."""

    @property
    def title(self) -> str:
        """Link and impairment."""
        return f"{self.link} {self.words}"

    def begin_s(self, zero_ns: int) -> float:
        """Return its start, s after a stamp."""
        return (self.begin_ns - zero_ns) / NS_PER_S

    def end_s(self, zero_ns: int) -> float | None:
        """Return its end, s after a stamp, or None if the log does not contain it."""
        return None if self.end_ns is None else (self.end_ns - zero_ns) / NS_PER_S

    def at(self, t_ns: int) -> bool:
        """Return True if it was active at a time."""
        return self.begin_ns <= t_ns and (self.end_ns is None or t_ns < self.end_ns)

    def when(self, zero_ns: int) -> str:
        """Return its interval in s after a stamp, for example `3.00 to 7.00 s`."""
        begin, end = self.begin_s(zero_ns), self.end_s(zero_ns)
        return f"from {begin:.2f} s on" if end is None else f"{begin:.2f} to {end:.2f} s"

    def counts(self) -> str:
        """Return the counts of passed and lost messages as text."""
        if self.passed is None:
            return "its end is not in the log"
        return f"{self.passed} messages passed, {self.lost} lost"


def impairments(events: Iterable[LinkEvent]) -> list[Impaired]:
    """Return all impairments in the order of their start.

    A killed network proxy records no end, and its successor counts from 1 again. So an impairment
    ends at the latest when another one with the same number starts.
    """
    found: list[list[LinkEvent]] = []
    ends: list[list[LinkEvent]] = []
    open_: dict[int, int] = {}
    for event in events:
        place = open_.get(event.number)
        if event.active:
            if place is None or found[place][0].t_ns != event.t_ns:
                place = open_[event.number] = len(found)
                found.append([])
                ends.append([])
            found[place].append(event)
        elif place is not None:
            ends[place].append(event)
    return [_of(begun, ended, found) for begun, ended in zip(found, ends, strict=True)]


def _of(
    begun: Sequence[LinkEvent], ended: Sequence[LinkEvent], all_: Sequence[Sequence[LinkEvent]]
) -> Impaired:
    first = begun[0]
    again = (row[0].t_ns for row in all_ if row[0].number == first.number)
    end_ns = ended[0].t_ns if ended else next((t for t in again if t > first.t_ns), None)
    return Impaired(
        link=first.requested,
        words=first.detail,
        directions=frozenset(event.link for event in begun),
        begin_ns=first.t_ns,
        end_ns=end_ns,
        passed=sum(event.passed for event in ended) if ended else None,
        lost=sum(event.lost for event in ended) if ended else None,
    )


def touches(
    rows: Iterable[Impaired], module: str, times_ns: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return, for each time, True if a link between the planner and a module was impaired."""
    mask = np.zeros(len(times_ns), dtype=bool)
    for row in rows:
        if row.directions & {f"planner->{module}", f"{module}->planner"}:
            end_ns = LAST_NS if row.end_ns is None else row.end_ns
            mask |= (times_ns >= row.begin_ns) & (times_ns < end_ns)
    return mask
