"""Tables of `xrl bench`: medians of turns, ratios to another revision, targets; and their flags."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, NamedTuple

from rich import box
from rich.table import Table
from rich.text import Text

from shared.atomic_file import replace_file
from shared.exceptions import FAULT_EXIT_CODE
from tools.flags import Arg, ConfigFlags, Count, Flags, parsed
from tools.judge.verdict_table import digits
from tools.terminal import Console, marked

if TYPE_CHECKING:  # it imports all parts of a robot
    from tools.lab.bench.worker import Answer, Request


class Row(NamedTuple):
    """One figure over all turns."""

    what: str
    unit: str
    """`x`: a speed, which is to be high; anything else is to be low."""
    value: float | None
    """Median of the turns; None: no turn has it."""
    spread: tuple[float, float] | None
    """Least and most of the turns."""
    other: float | None = None
    """The other revision's median."""
    ratio: float | None = None
    """This time over the other's, turn by turn, in the median; below 1 this tree is faster."""
    target: float | None = None

    @property
    def ok(self) -> bool:
        """True unless the target is missed."""
        if self.target is None or self.value is None:
            return True
        return self.value >= self.target if self.unit == "x" else self.value <= self.target

    def marked_target(self) -> Text | str:
        """Return the target and whether it is met, for a cell."""
        if self.target is None:
            return ""
        mark = Text("ok", "green") if self.ok else Text("missed", "yellow")
        return marked("{} {:g} {}", ">=" if self.unit == "x" else "<=", self.target, mark)


def compared(
    what: str,
    unit: str,
    here: Sequence[float | None],
    there: Sequence[float | None],
    target: float | None,
) -> Row:
    """Return a figure's row, from this tree's values by turn and the other tree's; None: none."""
    values = [value for value in here if value is not None]
    others = [value for value in there if value is not None]
    pairs = [(a, b) for a, b in zip(here, there, strict=False) if a is not None and b]
    ratios = [b / a if unit == "x" else a / b for a, b in pairs]
    return Row(
        what,
        unit,
        value=median(values) if values else None,
        spread=(min(values), max(values)) if values else None,
        other=median(others) if others else None,
        ratio=median(ratios) if ratios else None,
        target=target,
    )


class PartRow(NamedTuple):
    """One figure of the bench: CPU time in us, or times real time."""

    row: Row
    wall: float | None
    """Its value by the wall's clock; None: CPU time only."""
    to_yardstick: float
    """Time in units of the yardstick that ran right before it; a speed's is its inverse."""


def row_of(
    request: Request, turns: Sequence[Answer], others: Sequence[Answer], target: float | None
) -> PartRow | None:
    """Return the row of this tree's turns and the other tree's; None if this one lacks the part."""
    if any(turn.missing for turn in turns):
        return None
    walls = [turn.cost.wall.p50 for turn in turns if turn.cost is not None]
    what = f"{request.name}, {'cold' if request.cold else 'warm'}" if walls else request.name
    here, there = ([answer.value for answer in answers] for answers in (turns, others))
    # of a speed, the time of a millisecond
    times = [value if walls else 1e3 / value for value in here if value]
    return PartRow(
        compared(what, "us" if walls else "x", here, there, target),
        median(walls) if walls else None,
        median(us / turn.yardstick_us for us, turn in zip(times, turns, strict=True)),
    )


def print_table(console: Console, columns: Mapping[str, Iterable[Text | str]], note: str) -> None:
    """Print cells by heading, those of no heading to the left, and what they mean below them."""
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in columns:
        shown.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for row in zip(*columns.values(), strict=True):
        shown.add_row(*row)
    console.print(shown)
    console.print(note, style="dim")


def cell(value: float | None, unit: str = "") -> str:
    """Return a figure with its unit."""
    return "" if value is None else f"{digits(value)} {unit}".rstrip()


def _writable(text: str) -> Path:
    """Return a file's path; refused before minutes of measuring are lost to it."""
    file = Path(text)
    if file.is_dir() or not file.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text[:200]!r}: name a file in a folder that exists")
    return file


class BenchFlags(Flags):
    """How often, and where the figures go."""

    rounds: Annotated[Count | None, Arg(metavar="N")] = None
    """rounds of each (default: 9 for the parts, 3 else)"""
    json: Annotated[Path | None, parsed(_writable, "FILE")] = None
    """also write the figures to this file"""


class AgainstFlags(BenchFlags, ConfigFlags):
    """A tree, and one to compare it with."""

    against: Annotated[str | None, Arg(metavar="REV")] = None
    """also measure a git revision, in turn with this tree, and print the ratios; both run in this
    environment"""
    strict: Annotated[bool, Arg(help=f"exit code {FAULT_EXIT_CODE} if a target is missed")] = False

    def finish(self, rows: Sequence[Row], more: Iterable[Mapping[str, object]]) -> int:
        """Write each row, and what more there is of it; return the exit code."""
        pairs = zip(rows, more, strict=True)
        write_rows(self.json, [{**row._asdict(), **its} for row, its in pairs])
        return FAULT_EXIT_CODE if self.strict and not all(row.ok for row in rows) else 0


def compared_columns(rows: Sequence[Row], against: str, *, units: bool) -> dict[str, list[str]]:
    """Return the other revision's figures, and this tree's ratios to them."""
    return {
        against: [cell(row.other, row.unit if units else "") for row in rows],
        "ratio": ["" if row.ratio is None else f"{row.ratio:.2f}" for row in rows],
    }


def write_rows(file: Path | None, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table's rows to the file of `--json`, if there is one."""
    if file is not None:
        replace_file(file, json.dumps(rows, indent=2).encode() + b"\n")
