"""Rows of `xrl bench` from its answers: medians, and the ratio to another revision. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

from tools.lab.bench.worker import Answer, Request


class Row(NamedTuple):
    """One figure of the bench."""

    what: str
    unit: str
    value: float
    """Median of the turns' medians: CPU time in us, or times real time."""
    wall: float | None
    """The same by the wall's clock; None: CPU time only."""
    spread: tuple[float, float]
    """Least and most of the turns."""
    to_yardstick: float
    """Time in units of the yardstick that ran right before it; a speed's is its inverse."""
    other: float | None = None
    """The other revision's."""
    ratio: float | None = None
    """This time over the other's, turn by turn, in the median; below 1 this tree is faster."""
    target: float | None = None

    @property
    def ok(self) -> bool:
        """True unless the target is missed."""
        if self.target is None:
            return True
        return self.value >= self.target if self.unit == "x" else self.value <= self.target


def row_of(
    request: Request, turns: Sequence[Answer], others: Sequence[Answer], target: float | None
) -> Row | None:
    """Return a row; None if this tree does not have the part.

    Args:
        request: what was measured.
        turns: of this tree.
        others: of the other tree, in turn with them; empty: none.
        target: us of CPU time, or times real time; None: none.
    """
    if any(turn.missing for turn in turns):
        return None
    values = [_value(turn) for turn in turns]
    times = [_time_us(turn) for turn in turns]
    present = [other for other in others if not other.missing]
    walls = [turn.cost.wall.p50 for turn in turns if turn.cost is not None]
    what = f"{request.name}, {'cold' if request.cold else 'warm'}" if walls else request.name
    return Row(
        what,
        "us" if walls else "x",
        median(values),
        median(walls) if walls else None,
        (min(values), max(values)),
        median(us / turn.yardstick_us for us, turn in zip(times, turns, strict=True)),
        median(map(_value, present)) if present else None,
        median(us / _time_us(other) for us, other in zip(times, present, strict=True))
        if present
        else None,
        target,
    )


def _value(turn: Answer) -> float:
    return turn.cost.cpu.p50 if turn.cost is not None else turn.speed or 0.0


def _time_us(turn: Answer) -> float:
    """Return CPU time, us: of a speed, that of a millisecond."""
    return turn.cost.cpu.p50 if turn.cost is not None else 1e3 / (turn.speed or 1.0)
