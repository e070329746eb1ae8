"""The doctor's findings: rows, each with a verdict and, if it is not ok, what to do."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Final

import msgspec


class Verdict(StrEnum):
    """What a row means."""

    OK = "ok"
    WARNING = "warning"
    """The robot may run, and somebody should know."""
    WRONG = "wrong"
    """The robot must not be let down from its hoist like this."""


class Row(msgspec.Struct, frozen=True):
    """One finding."""

    subject: str
    """Module, or "knee_left.axis0", or what else it is about."""
    what: str
    found: str
    wanted: str
    verdict: Verdict
    fix: str = ""
    """What to do about it; commands in backquotes."""
    why: str = ""
    """What happens otherwise."""


ALL: Final = "all"
"""Subject of a row that stands for several alike."""


def ok(subject: str, what: str, found: str, wanted: str = "") -> Row:
    """Return a row that needs nothing."""
    return Row(subject, what, found, wanted, Verdict.OK)


def warning(subject: str, what: str, found: str, wanted: str, fix: str, why: str = "") -> Row:
    """Return a row that somebody should know of."""
    return Row(subject, what, found, wanted, Verdict.WARNING, fix, why)


def wrong(subject: str, what: str, found: str, wanted: str, fix: str, why: str = "") -> Row:
    """Return a row that keeps the robot in its hoist."""
    return Row(subject, what, found, wanted, Verdict.WRONG, fix, why)


def judged(
    good: bool,
    subject: str,
    what: str,
    found: str,
    wanted: str,
    fix: str,
    why: str = "",
    *,
    otherwise: Verdict = Verdict.WRONG,
) -> Row:
    """Return a row that is ok if it is good, else `otherwise`, with what to do."""
    if good:
        return ok(subject, what, found, wanted)
    return Row(subject, what, found, wanted, otherwise, fix, why)


def count(rows: Iterable[Row], verdict: Verdict) -> int:
    """Return how many rows have a verdict."""
    return sum(row.verdict is verdict for row in rows)


def merged(rows: Iterable[Row]) -> list[Row]:
    """Return the rows with those that are ok and about the same matter put into one.

    The order is that of the first of each; what is not ok stays as it is, after them.
    """
    alike: dict[str, list[Row]] = {}
    others = []
    for row in rows:
        if row.verdict is Verdict.OK:
            alike.setdefault(row.what, []).append(row)
        else:
            others.append(row)
    return [_one(group) for group in alike.values()] + others


def _one(group: list[Row]) -> Row:
    """Return the row that stands for rows of one matter."""
    first = group[0]
    if len(group) == 1:
        return first
    wanted = first.wanted if len({row.wanted for row in group}) == 1 else ""
    return msgspec.structs.replace(
        first,
        subject=f"{ALL} {len(group)}",
        found=_together([row.found for row in group]),
        wanted=wanted,
    )


def _together(values: list[str]) -> str:
    """Return one text for several: itself if they agree, else the smallest and the largest."""
    distinct = sorted(set(values), key=_by_number)
    return distinct[0] if len(distinct) == 1 else f"{distinct[0]} .. {distinct[-1]}"


def _by_number(text: str) -> tuple[float, str]:
    """Return what sorts "9 ms" before "10 ms"."""
    try:
        return float(text.partition(" ")[0]), text
    except ValueError:
        return 0.0, text
