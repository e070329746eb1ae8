"""Findings of `xrl doctor`: rows with a verdict and a remedy, merged, counted and printed."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from itertools import chain
from typing import Final

import msgspec
from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from shared.can.drive_settings import AXES
from shared.joints import MODULES
from tools.terminal import Console


class FindingKind(StrEnum):
    """Verdict of a row."""

    OK = "ok"
    WARNING = "warning"
    """A person should know, but the robot may run."""
    WRONG = "wrong"
    """The robot must not be lowered from its hoist in this state."""


class Finding(msgspec.Struct, frozen=True):
    """One finding."""

    subject: str
    """Module, axis ("knee_left.axis0") or other part."""
    what: str
    found: str
    wanted: str
    verdict: FindingKind
    fix: str = ""
    """Remedy; commands in backquotes."""
    why: str = ""
    """Consequence if it is not fixed, or a possible cause."""


Groups = dict[str, list[Finding]]
"""Rows by heading."""
WIDE: Final = 110
"""Minimum console width for a column of remedies; otherwise they follow the table."""
COLOURS: Final = {
    FindingKind.OK: "green",
    FindingKind.WARNING: "yellow",
    FindingKind.WRONG: "bold red",
}
NAME_MAX: Final = 22
"""Maximum length of a name that is not broken into two lines."""
NAMED_MAX: Final = 6
"""Maximum number of findings that the verdict line names."""
ALL: Final = "all"
"""Subject of a row that merges several rows."""

_MODULES: Final = set(MODULES)
_AXES: Final = {f"{module}.{axis}" for module in MODULES for axis in AXES}


def ok(subject: str, what: str, found: str, wanted: str = "") -> Finding:
    """Return a row that needs no action."""
    return Finding(subject, what, found, wanted, FindingKind.OK)


def warning(subject: str, what: str, found: str, wanted: str, fix: str, why: str = "") -> Finding:
    """Return a row that a person should know about."""
    return Finding(subject, what, found, wanted, FindingKind.WARNING, fix, why)


def wrong(subject: str, what: str, found: str, wanted: str, fix: str, why: str = "") -> Finding:
    """Return a row that forbids lowering the robot from its hoist."""
    return Finding(subject, what, found, wanted, FindingKind.WRONG, fix, why)


def judged(good: bool, *row: str) -> Finding:
    """Return an ok row if good, else a wrong row; `row` has the arguments of `wrong`."""
    return ok(*row[:4]) if good else wrong(*row)


def advised(good: bool, *row: str) -> Finding:
    """Return an ok row if good, else a warning; `row` has the arguments of `warning`."""
    return ok(*row[:4]) if good else warning(*row)


def merged(rows: Iterable[Finding]) -> list[Finding]:
    """Merge rows of the same check; return the ok rows first.

    All ok rows of a check become one, with the range of their values. Other rows are merged only if
    all six modules, all twelve axes or both axes of a module have the same finding, so boards with
    factory settings do not fill the table.
    """
    alike: dict[tuple[str, ...], list[Finding]] = {}
    for row in rows:
        is_ok = row.verdict is FindingKind.OK
        matter = (row.what, row.wanted, row.verdict, row.why, _anywhere(row))
        alike.setdefault((row.what,) if is_ok else matter, []).append(row)
    good, bad = [], []
    for group in alike.values():
        subjects = {row.subject for row in group}
        if group[0].verdict is FindingKind.OK:
            good.append(_one(group, f"{ALL} {len(group)}"))
        elif len(subjects) == len(group) and subjects in (_MODULES, _AXES):
            all_alike = _one(group, f"{ALL} {len(group)}")
            bad.append(msgspec.structs.replace(all_alike, fix=_anywhere(group[0])))
        else:
            by_module: dict[str, list[Finding]] = {}
            for row in group:
                module, _, axis = row.subject.partition(".")
                by_module.setdefault(module if axis in AXES else row.subject, []).append(row)
            bad += [_one(both, f"{module}, both") for module, both in by_module.items()]
    return good + bad


def _anywhere(row: Finding) -> str:
    """Return the remedy of a row, with MODULE in place of the module's name."""
    module = row.subject.partition(".")[0]
    return row.fix.replace(f" --module {module}", "").replace(module, "MODULE")


def _one(group: list[Finding], subject: str) -> Finding:
    """Return one row for several rows of a check, with the range of their values."""
    first = group[0]
    if len(group) == 1:
        return first
    values = sorted({row.found for row in group}, key=_by_number)
    found = values[0] if len(values) == 1 else f"{values[0]} .. {values[-1]}"
    wanted = first.wanted if len({row.wanted for row in group}) == 1 else ""
    return msgspec.structs.replace(first, subject=subject, found=found, wanted=wanted)


def _by_number(text: str) -> tuple[float, str]:
    """Return a sort key that puts "9 ms" before "10 ms"."""
    try:
        return float(text.partition(" ")[0]), text
    except ValueError:
        return 0.0, text


class Report(msgspec.Struct, frozen=True):
    """Output of `xrl doctor --json`."""

    ok: bool
    """True if nothing is wrong; there may be warnings."""
    wrong: int
    warnings: int
    groups: dict[str, list[Finding]]


def report_of(groups: Groups) -> Report:
    """Return the findings with their counts."""
    verdicts = [row.verdict for row in chain(*groups.values())]
    wrong = verdicts.count(FindingKind.WRONG)
    return Report(wrong == 0, wrong, verdicts.count(FindingKind.WARNING), groups)


def show(console: Console, groups: Groups, *, verbose: bool) -> None:
    """Print the findings, then the verdict line."""
    for title, rows in groups.items():
        console.print(_group(title, rows if verbose else merged(rows), console.width))
    report = report_of(groups)
    worst = FindingKind.WARNING if report.warnings else FindingKind.OK
    style = COLOURS[worst if report.ok else FindingKind.WRONG]
    console.print(Text(verdict_line(groups), style=style))


def verdict_line(groups: Groups) -> str:
    """Return the verdict in one line: "all ok", or the counts and names of bad rows."""
    report = report_of(groups)
    warnings = report.warnings
    noted = f"{warnings} warning{'s' * (warnings != 1)}: {_names(groups, FindingKind.WARNING)}"
    if report.wrong:
        text = f"{report.wrong} wrong: {_names(groups, FindingKind.WRONG)}"
        return f"{text}; {noted}" if warnings else text
    return f"nothing wrong; {noted}" if warnings else "all ok"


def _group(title: str, rows: list[Finding], width: int) -> RenderableType:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("part", no_wrap=True, min_width=12)
    table.add_column("check", no_wrap=True, min_width=16)
    table.add_column("found", overflow="fold")
    table.add_column("wanted", overflow="fold")
    table.add_column("", no_wrap=True, min_width=max(len(row.verdict) for row in rows))
    wide = width >= WIDE and any(row.fix for row in rows)
    if wide:
        table.add_column("what to do", overflow="fold")
    subjects: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        head, _, tail = row.what.rpartition(".")
        is_long = len(row.what) > NAME_MAX and head
        cells = (row.subject, f"{head}.\n{tail}" if is_long else row.what, row.found, row.wanted)
        verdict = Text(row.verdict, COLOURS[row.verdict])
        table.add_row(*cells, verdict, *([row.fix] if wide else []))
        fix = "" if wide else row.fix
        if note := f"{fix} ({row.why})" if fix and row.why else fix or row.why:
            subjects.setdefault((row.what, note), []).append(row.subject)
    # print a text that several rows share only once
    notes = [f"{', '.join(who)} {what}: {note}" for (what, note), who in subjects.items()]
    below = [Padding(Text(note), (0, 0, 0, 2), expand=False) for note in notes]
    return Group(table, *below, *([Text("")] if below else []))


def _names(groups: Groups, verdict: FindingKind) -> str:
    """Return the names of the first rows with a verdict, and the number of the others."""
    rows = [row for group in groups.values() for row in merged(group) if row.verdict is verdict]
    names = [
        # the last part of a setting's name
        f"{row.subject} {row.what.rpartition('.')[2] if 'config.' in row.what else row.what}"
        for row in rows[:NAMED_MAX]
    ]
    more = len(rows) - NAMED_MAX
    return ", ".join(names) + (f" and {more} more" if more > 0 else "")
