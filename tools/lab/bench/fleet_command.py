"""`xrl bench fleet`: the whole fleet, led live; one revision beside another."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Annotated, Final

from rich import box
from rich.progress import track
from rich.table import Table
from rich.text import Text

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.exceptions import FAULT_EXIT_CODE
from shared.extras import require
from shared.places import CHECKOUT
from shared.toml_file import Range
from tools.flags import Arg
from tools.fleet.others import warn_of_others
from tools.fleet.pace import PACE_MIN
from tools.judge.verdict_table import digits
from tools.lab.bench import fleet
from tools.lab.bench.flags import AgainstFlags, write_rows
from tools.lab.bench.fleet import FleetRow, Turn
from tools.lab.bench.revisions import its_config, unpacked
from tools.terminal import Console, marked

ROUNDS: Final = 3


class FleetFlags(AgainstFlags):
    """What is led."""

    scenario: Annotated[str, Arg(metavar="NAME|FILE")] = "squat"
    """what happens, as of `xrl demo` (default: squat, the paper's Fig. 7)"""
    pace: Annotated[float, Range(PACE_MIN, 1.0, ""), Arg(metavar="X")] = 1.0
    """clock rate of the fleet; it is not lowered on full cores, and the targets are those of 1"""


def run(flags: FleetFlags) -> int:
    """Lead each tree in turn and print the medians; with --strict a missed target is a fault.

    A shared machine may be twice as slow from one minute to the next: the ratio of two trees that
    ran side by side says more than a time.
    """
    require("sim")
    robot = config_file.load(flags.config)
    gain_schedule.require(robot, flags.config)
    console = Console()
    warn_of_others(console)
    config = flags.config.resolve()
    turns: list[list[Turn]] = []
    with ExitStack() as stack:
        trees = [(CHECKOUT, config)]
        if flags.against is not None:
            other = stack.enter_context(unpacked(flags.against))
            trees.append((other, its_config(config, other)))
        runs = [tree for _ in range(flags.rounds or ROUNDS) for tree in trees]
        found = [
            fleet.measure(tree, its, flags.scenario, flags.pace)
            for tree, its in track(runs, "leading", console=console, transient=True)
        ]
        turns = [found[number :: len(trees)] for number in range(len(trees))]
    rows = fleet.rows(turns[0], turns[1] if len(turns) > 1 else (), flags.pace)
    console.print(_table(rows, flags.against))
    console.print(
        "Medians of the turns. CPU: in percent of one core. Late: later than two periods. "
        "Age: of a command, from the module's state that it answers to the cycle that takes it.",
        style="dim",
    )
    write_rows(flags.json, [row.as_dict() for row in rows])
    return FAULT_EXIT_CODE if flags.strict and not all(row.ok for row in rows) else 0


def _table(rows: list[FleetRow], against: str | None) -> Table:
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    compared = ["least .. most"] if against is None else [against, "ratio"]
    for column in ("", "here", *compared, "target"):
        shown.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        unit = row.figure.unit
        cells = [row.figure.what, _number(row.value, unit)]
        if against is None:
            cells.append("" if row.spread is None else " .. ".join(map(digits, row.spread)))
        else:
            cells += [_number(row.other, unit), "" if row.ratio is None else f"{row.ratio:.2f}"]
        mark = Text("ok", "green") if row.ok else Text("missed", "yellow")
        shown.add_row(*cells, "" if row.target is None else marked("<= {:g} {}", row.target, mark))
    return shown


def _number(value: float | None, unit: str) -> str:
    return "" if value is None else f"{digits(value)} {unit}"
