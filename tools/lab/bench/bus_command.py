"""`xrl bench bus`: the fleet's pattern of messages over every transport that is installed."""

from __future__ import annotations

from typing import Annotated, Final

from rich import box
from rich.progress import track
from rich.table import Table

from shared.extras import missing_package
from tools.flags import Arg, Duration
from tools.lab.bench import bus
from tools.lab.bench.flags import BenchFlags, write_rows
from tools.lab.bench.transports.base import TRANSPORTS, installed
from tools.terminal import Console

ROUNDS: Final = 3


class BusFlags(BenchFlags):
    """Which transports, and how long."""

    transport: Annotated[
        tuple[str, ...], Arg(choices=tuple(row.name for row in TRANSPORTS), metavar="NAME")
    ] = ()
    """one of them; repeat it for several (default: all that are installed; those beyond Zenoh and
    datagrams come with the extra `bench`)"""
    seconds: Duration = 10.0
    """of each run"""


def run(flags: BusFlags) -> int:
    """Measure the transports in turn and print their medians.

    Six modules at 500 Hz and a planner at 250 Hz, as processes that only send and receive.
    """
    present = installed()
    names = flags.transport or list(present)
    for name in names:
        if name not in present:
            raise missing_package("bench", [name])
    console = Console()
    rounds = [
        [bus.measure(name, flags.seconds) for name in names]
        for _ in track(range(flags.rounds or ROUNDS), "measuring", console=console, transient=True)
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
    write_rows(flags.json, [row._asdict() for row in rows])
    return 0
