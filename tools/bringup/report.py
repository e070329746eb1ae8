"""The doctor's findings for the terminal and for machines."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Final

import msgspec
from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from tools.bringup.rows import Finding, FindingKind, count, merged
from tools.bringup.survey import Groups
from tools.terminal import Console

WIDE: Final = 110
"""Columns from which what to do stands beside a finding; else it stands below its table."""
COLOURS: Final = {
    FindingKind.OK: "green",
    FindingKind.WARNING: "yellow",
    FindingKind.WRONG: "bold red",
}
NAME_MAX: Final = 22
"""Longest name on one line."""
NAMED_MAX: Final = 6
"""Findings that the last line names."""


class Report(msgspec.Struct, frozen=True):
    """What `xrl doctor --json` prints."""

    ok: bool
    """Nothing is wrong; there may be warnings."""
    wrong: int
    warnings: int
    groups: dict[str, list[Finding]]


def report_of(groups: Groups) -> Report:
    """Return the findings with their counts."""
    rows = list(chain(*groups.values()))
    wrong = count(rows, FindingKind.WRONG)
    return Report(wrong == 0, wrong, count(rows, FindingKind.WARNING), groups)


def show(console: Console, groups: Groups, *, verbose: bool) -> None:
    """Print the findings, and one line for all of them."""
    for title, rows in groups.items():
        console.print(_group(title, rows if verbose else merged(rows), console.width))
    console.print(Text(verdict_line(groups), style=COLOURS[_worst(chain(*groups.values()))]))


def verdict_line(groups: Groups) -> str:
    """Return "all ok", or how much is wrong and what: the command's answer in a line."""
    rows = list(chain(*groups.values()))
    put_together = [row for group in groups.values() for row in merged(group)]
    wrong, warnings = count(rows, FindingKind.WRONG), count(rows, FindingKind.WARNING)
    named = _names(row for row in put_together if row.verdict is FindingKind.WARNING)
    noted = f"{warnings} warning{'s' * (warnings != 1)}: {named}"
    if wrong:
        named = _names(row for row in put_together if row.verdict is FindingKind.WRONG)
        text = f"{wrong} wrong: {named}"
        return f"{text}; {noted}" if warnings else text
    return f"nothing wrong; {noted}" if warnings else "all ok"


def _group(title: str, rows: list[Finding], width: int) -> RenderableType:
    wide = width >= WIDE
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    names = {row.what: _broken(row.what) for row in rows}
    table.add_column("part", no_wrap=True, min_width=12)
    table.add_column("what", no_wrap=True, min_width=16)
    table.add_column("found", overflow="fold")
    table.add_column("wanted", overflow="fold")
    table.add_column("", no_wrap=True, min_width=max(len(row.verdict) for row in rows))
    wide = wide and any(row.fix for row in rows)
    if wide:
        table.add_column("what to do", overflow="fold")
    for row in rows:
        cells = (row.subject, names[row.what], row.found, row.wanted)
        verdict = Text(row.verdict, COLOURS[row.verdict])
        table.add_row(*cells, verdict, *([row.fix] if wide else []))
    below = [Padding(Text(note), (0, 1, 0, 2)) for note in _notes(rows, wide=wide)]
    return Group(table, *below, *([Text("")] if below else []))


def _notes(rows: list[Finding], *, wide: bool) -> list[str]:
    """Return the lines below the table; a text that several rows share appears once."""
    subjects: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if note := _note(row, wide=wide):
            subjects.setdefault((row.what, note), []).append(row.subject)
    return [f"{', '.join(who)} {what}: {note}" for (what, note), who in subjects.items()]


def _broken(name: str) -> str:
    """Return a setting's name on two lines: it is too long for a column."""
    if len(name) <= NAME_MAX or "." not in name:
        return name
    head, _, tail = name.rpartition(".")
    return f"{head}.\n{tail}"


def _note(row: Finding, *, wide: bool) -> str:
    """Return the text on a row below the table: why, and the remedy if it has no column."""
    fix = "" if wide else row.fix
    return f"{fix} ({row.why})" if fix and row.why else fix or row.why


def _names(rows: Iterable[Finding]) -> str:
    """Return the first of the rows, and how many more lines there are."""
    names = [f"{row.subject} {_short(row.what)}" for row in rows]
    more = len(names) - NAMED_MAX
    return ", ".join(names[:NAMED_MAX]) + (f" and {more} more" if more > 0 else "")


def _short(name: str) -> str:
    """Return the last part of a setting's name; any other name unchanged."""
    return name.rpartition(".")[2] if "config." in name else name


def _worst(rows: Iterable[Finding]) -> FindingKind:
    verdicts = {row.verdict for row in rows}
    for verdict in (FindingKind.WRONG, FindingKind.WARNING):
        if verdict in verdicts:
            return verdict
    return FindingKind.OK
