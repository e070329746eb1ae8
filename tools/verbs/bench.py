"""`xrl bench`: what each part of the fleet costs here, and its bus beside other transports.

Absolute times of a busy machine say little. Two versions are compared by `--against`, which runs
both in turn, or by the ratio of each figure to a yardstick that ran beside it.
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from shared.config import files as config_file
from shared.exceptions import RunError
from shared.process import CHECKOUT
from shared.robot import gain_schedule
from tools.bench import bus, revisions, table
from tools.bench.parts import LOCKSTEP, LOCKSTEP_RECORDED, PARTS
from tools.bench.revisions import Worker
from tools.bench.table import Row
from tools.bench.timing import ASLEEP_S, SWEPT_BYTES, YARDSTICK_CALLS
from tools.bench.transports.base import TRANSPORTS, installed
from tools.bench.worker import READY, Request
from tools.number_arguments import count, finite
from tools.verb_table import Subparsers, add_config, add_verb

WARM_CALLS: Final = 200
COLD_CALLS: Final = 60
ROUNDS: Final = 9
BUS_ROUNDS: Final = 3
"""Calls of a turn: a few tenths of a second."""
SPEEDS: Final = {LOCKSTEP: 10.0, LOCKSTEP_RECORDED: 7.0}
"""Targets of docs/results.md#targets, times real time."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "bench",
        """
        xrl bench
        xrl bench --against HEAD~1
        xrl bench --rounds 25 --json bench.json
        xrl bench bus                                # the bus beside other transports
        """,
    )
    parser.set_defaults(bench=run_parts)
    add_config(parser)
    parser.add_argument(
        "--against",
        metavar="REV",
        help="measure a git revision too, in turn with this tree, and print the ratios; both run "
        "in this environment",
    )
    parser.add_argument(
        "--rounds", type=count, metavar="N", help="turns of every measurement (9; of a transport 3)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument("--strict", action="store_true", help="exit 1 if a target is missed")
    others = parser.add_subparsers(metavar="WHAT", title="something else to measure")
    bus_parser = others.add_parser(
        "bus",
        help="the fleet's pattern of messages over Zenoh and over other transports",
        description="Run six modules at 500 Hz and a planner at 250 Hz, as processes that only "
        "send and receive, over each transport that is installed. Those beyond Zenoh and "
        "datagrams come with `pip install -e '.[bench]'`.",
        epilog="examples:\n  xrl bench bus\n"
        "  xrl bench bus --transport zenoh --transport datagrams --seconds 30",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    bus_parser.add_argument(
        "--transport",
        action="append",
        choices=[row.name for row in TRANSPORTS],
        help="one of them; repeat it for several (default: all that are installed)",
    )
    bus_parser.add_argument(
        "--seconds", type=finite, default=10.0, metavar="S", help="of each run, s (10)"
    )
    bus_parser.add_argument(
        "--rounds",
        type=count,
        default=argparse.SUPPRESS,
        metavar="N",
        help="of every transport (3)",
    )
    bus_parser.add_argument(
        "--json",
        type=Path,
        default=argparse.SUPPRESS,
        metavar="FILE",
        help="write the figures there too",
    )
    bus_parser.set_defaults(bench=run_bus)


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    code: int = args.bench(args)
    return code


def run_bus(args: argparse.Namespace) -> int:
    """Measure the transports in turn and print their medians."""
    if not args.seconds > 0.0:
        raise RunError(f"--seconds {args.seconds:g}: above 0")
    present = installed()
    names = args.transport or list(present)
    for name in names:
        if name not in present:
            raise RunError(f"{name} is not installed; `pip install -e '.[bench]'` does it")
    console = Console()
    rounds = [
        [bus.measure(name, args.seconds) for name in names]
        for _ in track(
            range(args.rounds or BUS_ROUNDS), "measuring", console=console, transient=True
        )
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
    if args.json is not None:
        text = json.dumps([row._asdict() for row in rows], indent=2) + "\n"
        args.json.write_text(text, encoding="utf-8")
    return 0


def run_parts(args: argparse.Namespace) -> int:
    """Measure the parts and print; with --strict 1 if a target is missed."""
    gain_schedule.require(config_file.load(args.config), args.config)
    console = Console()
    rows, missing = measure(args.config.resolve(), args.against, args.rounds or ROUNDS, console)
    console.print(_table(rows, args.against))
    for line in missing:
        console.print(f"[yellow]{line}[/]")
    console.print(
        "Medians of the rounds' medians, us; CPU is the calling thread's. "
        f"Cold: {SWEPT_BYTES >> 20} MiB are swept and {1e3 * ASLEEP_S:g} ms slept before a call. "
        f"Yardstick: {YARDSTICK_CALLS} solutions of a 12 x 12 system in NumPy.",
        style="dim",
    )
    if args.json is not None:
        text = json.dumps([row._asdict() for row in rows], indent=2) + "\n"
        args.json.write_text(text, encoding="utf-8")
    return 1 if args.strict and not all(row.ok for row in rows) else 0


def measure(
    config: Path, against: str | None, rounds: int, console: Console
) -> tuple[list[Row], list[str]]:
    """Return the table's rows, and what could not be measured.

    Args:
        config: robot file; of one in this checkout the other revision takes its own version.
        against: a git revision that measures in turn with this tree, or None.
        rounds: turns of each.
        console: for the progress.
    """
    with ExitStack() as stack:
        workers = [stack.enter_context(Worker(CHECKOUT, config))]
        if against is not None:
            other = stack.enter_context(revisions.unpacked(against))
            inside = config.is_relative_to(CHECKOUT)
            its_config = other / config.relative_to(CHECKOUT) if inside else config
            workers.append(stack.enter_context(Worker(other, its_config)))
        for worker in workers:  # the machine is then this measurement's alone
            worker.ask(READY)
        plan = [
            (Request(part.name, cold=cold, calls=COLD_CALLS if cold else WARM_CALLS), target)
            for part in PARTS
            for cold, target in ((False, part.warm_us), (True, part.cold_us))
        ]
        plan += [(Request(name), target) for name, target in SPEEDS.items()]
        rows, missing = [], []
        for request, target in track(plan, "measuring", console=console, transient=True):
            turns = [[worker.ask(request) for worker in workers] for _ in range(rounds)]
            here, *there = zip(*turns, strict=True)
            row = table.row_of(request, here, there[0] if there else (), target)
            rows += [] if row is None else [row]
            for tree, answer in zip(("here", f"in {against}"), turns[0], strict=False):
                if answer.missing and not request.cold:
                    missing.append(f"{request.name}: not measured {tree}: {answer.missing}")
    return rows, missing


def _table(rows: list[Row], against: str | None) -> Table:
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    compared = ["/ yard"] if against is None else [against, "ratio"]
    for column in ("", "CPU", "wall", *compared, "target"):
        shown.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        cells = [row.what, f"{_number(row.value)} {row.unit}", _number(row.wall)]
        if against is None:
            cells.append(_number(row.to_yardstick))
        else:
            cells += [_number(row.other), "" if row.ratio is None else f"{row.ratio:.2f}"]
        sign = ">=" if row.unit == "x" else "<="
        mark = "[green]ok[/]" if row.ok else "[yellow]missed[/]"
        cells.append("" if row.target is None else f"{sign} {row.target:g} {mark}")
        shown.add_row(*cells)
    return shown


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
