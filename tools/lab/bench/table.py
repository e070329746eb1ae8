"""Flags and tables of `xrl bench`: medians, targets, and ratios to another revision."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final, NamedTuple, TypeAlias

from rich import box
from rich.progress import track
from rich.table import Table
from rich.text import Text

from shared.atomic_file import replace_file
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.places import CHECKOUT, need_checkout
from tools.flags import Arg, ConfigFlags, Count, Flags, parsed
from tools.judge.verdict_table import digits
from tools.terminal import Console, marked

PATIENCE_S: Final = 600.0
"""Timeout for one turn of another tree, or one run of a fleet, s."""
ENDING_S: Final = 30.0
"""Timeout for an interrupted run to end its fleet, s."""
Turn: TypeAlias = dict[str, float | None]
"""A turn's figures by name; None for a missing one."""


class Figure(NamedTuple):
    """One figure of a bench."""

    what: str
    unit: str
    """`x` marks a speed, where higher is better; for all other units lower is better."""
    target: float | None = None


class Row(NamedTuple):
    """One figure over all turns."""

    what: str
    unit: str
    value: float | None
    """Median of the turns; None if no turn has the figure."""
    spread: tuple[float, float] | None
    """Minimum and maximum of the turns."""
    other: float | None = None
    """The other revision's median."""
    ratio: float | None = None
    """Median over the turns of this tree's figure divided by the other's; for a speed, the inverse.
    Below 1 this tree is better."""
    target: float | None = None

    @property
    def ok(self) -> bool:
        """False if the target is missed."""
        if self.target is None or self.value is None:
            return True
        return self.value >= self.target if self.unit == "x" else self.value <= self.target


def row_of(figure: Figure, here: Sequence[Turn], there: Sequence[Turn]) -> Row:
    """Return a figure's row, from this tree's turns and the other tree's."""
    what, unit, target = figure
    pairs = list(zip(here, there, strict=False))
    ratios = [
        b / a if unit == "x" else a / b
        for a, b in ((mine.get(what), other.get(what)) for mine, other in pairs)
        if a and b
    ]
    values = [value for turn in here if (value := turn.get(what)) is not None]
    others = [value for turn in there if (value := turn.get(what)) is not None]
    return Row(
        what,
        unit,
        value=median(values) if values else None,
        spread=(min(values), max(values)) if values else None,
        other=median(others) if others else None,
        ratio=median(ratios) if ratios else None,
        target=target,
    )


def _writable(text: str) -> Path:
    """Return a file's path; refuse a bad one before minutes of measuring are lost."""
    file = Path(text)
    if file.is_dir() or not file.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text[:200]!r}: must be a file in an existing folder")
    return file


class BenchFlags(Flags):
    """Number of rounds, and where the figures go."""

    rounds: Annotated[Count | None, Arg(metavar="N")] = None
    """number of rounds (default: 9 for `xrl bench`, else 3)"""
    json: Annotated[Path | None, parsed(_writable, "FILE")] = None
    """also write the figures to this file"""


class AgainstFlags(BenchFlags, ConfigFlags):
    """A tree to measure, and a tree to compare it with."""

    against: Annotated[str | None, Arg(metavar="REV")] = None
    """also measure a git revision with its own bench, in turn and in this environment; print the
    ratios"""
    strict: Annotated[bool, Arg(help=f"exit code {FAULT_EXIT_CODE} if a target is missed")] = False


def run_turns(
    flags: AgainstFlags,
    words: Sequence[str],
    rounds: int,
    measure: Callable[[], Turn],
    console: Console,
) -> tuple[list[Turn], list[Turn]]:
    """Return the turns of this tree, and those of the tree of `--against`, measured alternately.

    `measure` makes one turn of this tree; `words` are the verb with its flags, for a tree that
    runs in its own process.
    """
    each = track(range(rounds), "measuring", console=console, transient=True)
    if flags.against is None:
        return [measure() for _ in each], []
    with unpacked(flags.against) as other:
        pairs = [(_turn_of(CHECKOUT, words, flags.config), _turn_of(other, words, flags.config))
                 for _ in each]  # fmt: skip
    return [here for here, _ in pairs], [there for _, there in pairs]


def _turn_of(tree: Path, words: Sequence[str], config: Path) -> Turn:
    """Return one turn of a tree's own bench, with that tree's version of a robot file in it."""
    config = config.resolve()
    if config.is_relative_to(CHECKOUT):
        config = tree / config.relative_to(CHECKOUT)
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        run_tree(tree, [*words, "--rounds", "1", "--config", str(config), "--json", file.name])
        rows = json.loads(Path(file.name).read_bytes())
    return {row["what"]: row["value"] for row in rows}


@contextmanager
def unpacked(revision: str) -> Iterator[Path]:
    """Yield a folder with the tree of a git revision.

    Raises:
        RunError: this is not a checkout, git is missing, or it does not know the revision.
    """
    need_checkout("--against")
    with tempfile.TemporaryDirectory(prefix="xrl-bench-") as name:
        tree, archive = Path(name) / "tree", Path(name) / "tree.tar"
        words = ["git", "archive", "--format=tar", f"--output={archive}", revision]
        try:
            done = subprocess.run(words, check=False, cwd=CHECKOUT, capture_output=True, text=True)
        except FileNotFoundError:
            raise RunError("git is missing; --against needs it to read a revision") from None
        if done.returncode:
            reason = " ".join(done.stderr.strip().splitlines()[-1:])
            raise RunError(f"{revision}: no such git revision ({reason}); try one such as HEAD~1")
        with tarfile.open(archive) as packed:
            packed.extractall(tree)  # noqa: S202 - the archive is git's own
        with suppress(RunError):  # without these libraries, CasADi interprets the law
            run_tree(tree, [], "tools.graph_libraries")
        yield tree


def run_tree(tree: Path, words: Sequence[str], module: str = "tools.cli") -> str:
    """Run `xrl`, or another module, of a source tree; return its output. Ctrl-C reaches it too.

    Raises:
        RunError: it ended with an error, or timed out.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", module, *words],
        cwd=tree, env=os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        output = process.communicate(timeout=PATIENCE_S)[0]
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(ENDING_S)
        process.kill()
        raise RunError(f"{tree}: {module} has not ended after {PATIENCE_S:g} s") from None
    if process.returncode:
        last = " / ".join(output.strip().splitlines()[-3:])
        raise RunError(f"{tree}: {module} ended with exit code {process.returncode}: {last}")
    return output


def finish(flags: AgainstFlags, rows: Sequence[Row], note: str, console: Console) -> int:
    """Print and write the rows; return a fault if --strict and a target is missed, else 0."""
    columns: dict[str, list[Any]] = {
        "": [row.what for row in rows],
        "here": [_cell(row.value, row.unit) for row in rows],
    }
    if flags.against is None:
        spreads = (() if row.spread is None else map(digits, row.spread) for row in rows)
        columns["min .. max"] = [" .. ".join(spread) for spread in spreads]
    else:
        columns[flags.against] = [_cell(row.other, row.unit) for row in rows]
        columns["ratio"] = ["" if row.ratio is None else f"{row.ratio:.2f}" for row in rows]
    columns["target"] = [
        "" if row.target is None else marked(
            "{} {:g} {}", ">=" if row.unit == "x" else "<=", row.target,
            Text("ok", "green") if row.ok else Text("missed", "yellow"),
        )
        for row in rows
    ]  # fmt: skip
    print_table(console, columns, note)
    write_rows(flags.json, [row._asdict() for row in rows])
    return FAULT_EXIT_CODE if flags.strict and not all(row.ok for row in rows) else 0


def _cell(value: float | None, unit: str) -> str:
    return "" if value is None else f"{digits(value)} {unit}"


def print_table(console: Console, columns: Mapping[str, Iterable[Text | str]], note: str) -> None:
    """Print columns under their headings (left-aligned if the heading is empty), then a note."""
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in columns:
        shown.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for row in zip(*columns.values(), strict=True):
        shown.add_row(*row)
    console.print(shown)
    console.print(note, style="dim")


def write_rows(file: Path | None, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table's rows to the file of `--json`, if given."""
    if file is not None:
        replace_file(file, json.dumps(rows, indent=2).encode() + b"\n")
