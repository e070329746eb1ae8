"""`xrl bench fleet`: the whole fleet, led live; one revision beside another."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from typing import Final

from rich import box
from rich.progress import track
from rich.table import Table
from rich.text import Text

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.exceptions import FAULT_EXIT_CODE
from shared.extras import require
from shared.places import CHECKOUT
from tools.fleet.pace import check_pace
from tools.fleet.status_table import warn_of_others
from tools.judge.verdict_table import digits
from tools.lab.bench import fleet
from tools.lab.bench.flags import add_flags, write_rows
from tools.lab.bench.fleet import FleetRow, Turn
from tools.lab.bench.revisions import its_config, unpacked
from tools.number_arguments import finite
from tools.terminal import Console, marked
from tools.verb_table import Subparsers

ROUNDS: Final = 3


def add_parser(others: Subparsers) -> None:
    """Add the command."""
    parser = others.add_parser(
        "fleet",
        help="the whole fleet, led live through the paper's experiment",
        description="Run `xrl demo`, half a minute a turn, and print what the fleet costs, how old "
        "commands\nare when they are used, and what the hand meets. With --against another git "
        "revision is\nrun in turn with this tree: a shared machine may be twice as slow from one "
        "minute to the\nnext, so the ratio of two that ran side by side says more than a time.",
        epilog="examples:\n  xrl bench fleet\n"
        "  xrl bench fleet --against HEAD~1 --rounds 5 --json fleet.json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--against",
        default=argparse.SUPPRESS,
        metavar="REV",
        help="run a git revision too, in turn with this tree",
    )
    parser.add_argument(
        "--scenario",
        default="squat",
        metavar="NAME|FILE",
        help="what happens, as of `xrl demo` (squat, the paper's Fig. 7)",
    )
    parser.add_argument(
        "--pace",
        type=finite,
        default=1.0,
        metavar="X",
        help="clock rate of the fleet (1); it is not lowered on full cores, and the targets are "
        "those of 1",
    )
    add_flags(parser, ROUNDS, nested=True)
    parser.add_argument(
        "--strict",
        action="store_true",
        default=argparse.SUPPRESS,
        help=f"exit code {FAULT_EXIT_CODE} if a target is missed",
    )
    parser.set_defaults(bench=run)


def run(args: argparse.Namespace) -> int:
    """Lead each tree in turn and print the medians; with --strict a missed target is a fault."""
    require("sim")
    robot = config_file.load(args.config)
    gain_schedule.require(robot, args.config)
    check_pace(args.pace, simulated=True)
    console = Console()
    warn_of_others(console)
    config = args.config.resolve()
    turns: list[list[Turn]] = []
    with ExitStack() as stack:
        trees = [(CHECKOUT, config)]
        if args.against is not None:
            other = stack.enter_context(unpacked(args.against))
            trees.append((other, its_config(config, other)))
        runs = [tree for _ in range(args.rounds or ROUNDS) for tree in trees]
        found = [
            fleet.measure(tree, its, args.scenario, args.pace)
            for tree, its in track(runs, "leading", console=console, transient=True)
        ]
        turns = [found[number :: len(trees)] for number in range(len(trees))]
    rows = fleet.rows(turns[0], turns[1] if len(turns) > 1 else (), args.pace)
    console.print(_table(rows, args.against))
    console.print(
        "Medians of the turns. CPU: in percent of one core. Late: later than two periods. "
        "Age: of a command, from the module's state that it answers to the cycle that takes it.",
        style="dim",
    )
    write_rows(args.json, [row.as_dict() for row in rows])
    return FAULT_EXIT_CODE if args.strict and not all(row.ok for row in rows) else 0


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
