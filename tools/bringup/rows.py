"""The doctor's findings: rows, each with a verdict and, if it is not ok, what to do."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Final

import msgspec

from shared.can.drive_settings import AXES
from shared.joints import MODULES


class FindingKind(StrEnum):
    """Verdict of a row."""

    OK = "ok"
    WARNING = "warning"
    """The robot may run, and somebody should know."""
    WRONG = "wrong"
    """The robot must not be let down from its hoist like this."""


class Finding(msgspec.Struct, frozen=True):
    """One finding."""

    subject: str
    """Module, or "knee_left.axis0", or what else it is about."""
    what: str
    found: str
    wanted: str
    verdict: FindingKind
    fix: str = ""
    """What to do about it; commands in backquotes."""
    why: str = ""
    """What happens otherwise."""


ALL: Final = "all"
"""Subject of a row that stands for several alike."""

_MODULES: Final = set(MODULES)
_AXES: Final = {f"{module}.{axis}" for module in MODULES for axis in AXES}


def ok(subject: str, what: str, found: str, wanted: str = "") -> Finding:
    """Return a row that needs nothing."""
    return Finding(subject, what, found, wanted, FindingKind.OK)


def warning(subject: str, what: str, found: str, wanted: str, fix: str, why: str = "") -> Finding:
    """Return a row that somebody should know of."""
    return Finding(subject, what, found, wanted, FindingKind.WARNING, fix, why)


def wrong(subject: str, what: str, found: str, wanted: str, fix: str, why: str = "") -> Finding:
    """Return a row that keeps the robot in its hoist."""
    return Finding(subject, what, found, wanted, FindingKind.WRONG, fix, why)


def judged(
    good: bool,
    subject: str,
    what: str,
    found: str,
    wanted: str,
    fix: str,
    why: str = "",
    *,
    otherwise: FindingKind = FindingKind.WRONG,
) -> Finding:
    """Return a row that is ok if it is good, else `otherwise`, with what to do."""
    if good:
        return ok(subject, what, found, wanted)
    return Finding(subject, what, found, wanted, otherwise, fix, why)


def count(rows: Iterable[Finding], verdict: FindingKind) -> int:
    """Return how many rows have a verdict."""
    return sum(row.verdict is verdict for row in rows)


def merged(rows: Iterable[Finding]) -> list[Finding]:
    """Return the rows with those on the same subject merged.

    Rows that are ok become one, from the smallest to the largest value. Rows that are not ok merge
    where all six modules, all twelve axes, or both axes of a module are equal, so boards with
    factory settings do not fill the table. Rows that are ok come first, in the order of the first
    of each.
    """
    alike: dict[str, list[Finding]] = {}
    others: dict[tuple[str, ...], list[Finding]] = {}
    for row in rows:
        if row.verdict is FindingKind.OK:
            alike.setdefault(row.what, []).append(row)
        else:
            matter = (row.what, row.wanted, row.verdict, row.why, _anywhere(row))
            others.setdefault(matter, []).append(row)
    bad = [row for group in others.values() for row in _of_all_or_both_axes(group)]
    return [_one(group) for group in alike.values()] + bad


def _of_all_or_both_axes(group: list[Finding]) -> list[Finding]:
    """Return as few rows as can stand for rows of one matter, none of which is ok."""
    subjects = {row.subject for row in group}
    if len(subjects) == len(group) and subjects in (_MODULES, _AXES):
        return [msgspec.structs.replace(_one(group), fix=_anywhere(group[0]))]
    together = []
    for row in group:
        module, _, axis = row.subject.partition(".")
        both = [other for other in group if other.subject in {f"{module}.{a}" for a in AXES}]
        if axis not in AXES or len(both) != len(AXES):
            together.append(row)
        elif row is both[0]:
            together.append(msgspec.structs.replace(_one(both), subject=f"{module}, both"))
    return together


def _anywhere(row: Finding) -> str:
    """Return what to do about a row, whichever module it is about."""
    module = row.subject.partition(".")[0]
    return row.fix.replace(f" --module {module}", "").replace(module, "MODULE")


def _one(group: list[Finding]) -> Finding:
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
