"""Rows of `xrl bench` from its rounds: medians, and the ratio to another revision. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

from tools.bench.worker import Round


class Row(NamedTuple):
    """One figure of the bench."""

    what: str
    unit: str
    value: float
    """Median over the rounds of each round's median."""
    wall: float | None
    """The same by the wall's clock; None: CPU time only."""
    spread: tuple[float, float]
    """Least and most of the rounds."""
    to_yardstick: float
    """Time in units of the yardstick that ran in the same process; a speed's is its inverse."""
    other: float | None = None
    """The other revision's."""
    ratio: float | None = None
    """This over the other, round by round, in the median; below 1 this one is faster."""
    target: float | None = None

    @property
    def ok(self) -> bool:
        """True unless the target is missed."""
        if self.target is None:
            return True
        return self.value >= self.target if self.unit == "x" else self.value <= self.target


def timing(
    name: str, *, cold: bool, rounds: Sequence[Round], others: Sequence[Round], target: float | None
) -> Row | None:
    """Return the row of a part; None if this tree does not have it.

    Args:
        name: of the part.
        cold: of the cold calls.
        rounds: of this tree.
        others: of the other tree, in turn with them; empty: none.
        target: us of CPU time, or None.
    """
    costs = [(done.cold if cold else done.warm).get(name) for done in rounds]
    present = [cost for cost in costs if cost is not None]
    if not present:
        return None
    found = [(done.cold if cold else done.warm).get(name) for done in others]
    cpu = [cost.cpu.p50 for cost in present]
    past = [cost.cpu.p50 for cost in found if cost is not None]
    return Row(
        f"{name}, {'cold' if cold else 'warm'}",
        "us",
        median(cpu),
        median(cost.wall.p50 for cost in present),
        (min(cpu), max(cpu)),
        median(us / done.yardstick_us for us, done in zip(cpu, rounds, strict=False)),
        median(past) if past else None,
        median(now / then for now, then in zip(cpu, past, strict=False)) if past else None,
        target,
    )


def speed(
    name: str, *, rounds: Sequence[Round], others: Sequence[Round], target: float | None
) -> Row:
    """Return the row of a speed of lockstep; arguments as for `timing`, the target in times."""
    now, past = [done.speed[name] for done in rounds], [done.speed[name] for done in others]
    return Row(
        name,
        "x",
        median(now),
        None,
        (min(now), max(now)),
        median(1e3 / (value * done.yardstick_us) for value, done in zip(now, rounds, strict=True)),
        median(past) if past else None,
        median(then / value for value, then in zip(now, past, strict=True)) if past else None,
        target,
    )
