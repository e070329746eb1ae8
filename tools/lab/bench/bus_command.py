"""`xrl bench bus`: the fleet's pattern of messages over every transport that is installed."""

from __future__ import annotations

import argparse
from typing import Final

from rich import box
from rich.progress import track
from rich.table import Table

from shared.exceptions import RunError
from shared.extras import missing_package
from tools.lab.bench import bus
from tools.lab.bench.flags import add_flags, write_rows
from tools.lab.bench.transports.base import TRANSPORTS, installed
from tools.number_arguments import finite
from tools.terminal import Console
from tools.verb_table import Subparsers

ROUNDS: Final = 3


def add_parser(others: Subparsers) -> None:
    """Add the command."""
    parser = others.add_parser(
        "bus",
        help="the fleet's pattern of messages over Zenoh and over other transports",
        description="Run six modules at 500 Hz and a planner at 250 Hz, as processes that only "
        "send and\nreceive, over each transport that is installed. Those beyond Zenoh and "
        "datagrams come with\nthe extra `bench`.",
        epilog="examples:\n  xrl bench bus\n"
        "  xrl bench bus --transport zenoh --transport datagrams --seconds 30",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--transport",
        action="append",
        choices=[row.name for row in TRANSPORTS],
        help="one of them; repeat it for several (default: all that are installed)",
    )
    parser.add_argument(
        "--seconds", type=finite, default=10.0, metavar="S", help="of each run, s (10)"
    )
    add_flags(parser, ROUNDS, nested=True)
    parser.set_defaults(bench=run)


def run(args: argparse.Namespace) -> int:
    """Measure the transports in turn and print their medians."""
    if not args.seconds > 0.0:
        raise RunError(f"--seconds {args.seconds:g}: above 0")
    present = installed()
    names = args.transport or list(present)
    for name in names:
        if name not in present:
            raise missing_package("bench", [name])
    console = Console()
    rounds = [
        [bus.measure(name, args.seconds) for name in names]
        for _ in track(range(args.rounds or ROUNDS), "measuring", console=console, transient=True)
    ]
    rows = [bus.median_of(column) for column in zip(*rounds, strict=True)]
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("", "p50", "p99", "p99.9", "missed", "lost", "CPU"):
        shown.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        shown.add_row(
            row.transport,
            *(f"{us * 1e-3:.2f} ms" for us in (row.p50_us, row.p99_us, row.p999_us)),
            *(f"{100.0 * fraction:.2f} %" for fraction in (row.missed, row.lost)),
            f"{100.0 * row.cpu:.0f} %",
        )
    console.print(shown)
    console.print(
        "From the planner's put to a module's cycle, every 2 ms; medians of the rounds. "
        "Missed: a command came a cycle later than it could have. CPU: of all seven processes, in "
        "percent of one core.",
        style="dim",
    )
    write_rows(args.json, [row._asdict() for row in rows])
    return 0
