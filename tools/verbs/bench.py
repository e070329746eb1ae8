"""`xrl bench`: what each part of the fleet costs here; its bus and the whole fleet are beside it.

Absolute times of a busy machine say little. Two versions are compared by `--against`, which runs
both in turn, or by the ratio of each figure to a yardstick that ran beside it.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Final

from rich.progress import track

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.extras import require
from tools.lab.bench import bus as bus_bench
from tools.lab.bench import fleet as fleet_bench
from tools.lab.bench.parts import LOCKSTEP, LOCKSTEP_RECORDED, PARTS
from tools.lab.bench.revisions import trees as trees_of
from tools.lab.bench.revisions import worker
from tools.lab.bench.table import AgainstFlags, PartRow, cell, compared_columns, print_table, row_of
from tools.lab.bench.timing import ASLEEP_S, SWEPT_BYTES, YARDSTICK_CALLS
from tools.lab.bench.worker import READY, Request
from tools.terminal import Console, marked

WARM_CALLS: Final = 200
COLD_CALLS: Final = 60
ROUNDS: Final = 9
"""Calls of a turn: a few tenths of a second."""
SPEEDS: Final = {LOCKSTEP: 10.0, LOCKSTEP_RECORDED: 7.0}
"""Targets of docs/results.md#targets, times real time."""


EXAMPLES: Final = """
xrl bench
xrl bench --against HEAD~1
xrl bench --rounds 25 --json bench.json
xrl bench bus                                # the bus compared with other transports
xrl bench bus --transport zenoh --transport datagrams --seconds 30
xrl bench fleet                              # the whole fleet, live
xrl bench fleet --against HEAD~1 --rounds 5 --json fleet.json
"""

bus, fleet = bus_bench.run, fleet_bench.run


def run(flags: AgainstFlags) -> int:
    """Measure the parts and print; with --strict a missed target is a fault."""
    require("sim")
    gain_schedule.require(config_file.load(flags.config), flags.config)
    console = Console()
    parts, missing = measure(flags, console)
    rows = [part.row for part in parts]
    if flags.against is None:
        yards = [cell(part.to_yardstick) for part in parts]
        compare = {"wall": [cell(part.wall) for part in parts], "/ yard": yards}
    else:
        compare = compared_columns(rows, flags.against, units=False)
    print_table(
        console,
        {
            "": [row.what for row in rows],
            "CPU": [cell(row.value, row.unit) for row in rows],
            **compare,
            "target": [row.marked_target() for row in rows],
        },
        "Medians of the rounds' medians, us; CPU is the calling thread's. "
        f"Cold: {SWEPT_BYTES >> 20} MiB are swept and {1e3 * ASLEEP_S:g} ms slept before a call. "
        f"Yardstick: {YARDSTICK_CALLS} solutions of a 12 x 12 system in NumPy.",
    )
    for line in missing:
        console.print(marked("[yellow]{}[/]", line))
    more = [{"wall": part.wall, "to_yardstick": part.to_yardstick} for part in parts]
    return flags.finish(rows, more)


def measure(flags: AgainstFlags, console: Console) -> tuple[list[PartRow], list[str]]:
    """Return the table's rows, and what could not be measured; two trees measure in turn."""
    rounds = flags.rounds or ROUNDS
    with ExitStack() as stack:
        trees = stack.enter_context(trees_of(flags))
        asks = [stack.enter_context(worker(tree, config)) for tree, config in trees]
        for ask in asks:  # the machine is then this measurement's alone
            ask(READY)
        plan = [
            (Request(part.name, cold=cold, calls=COLD_CALLS if cold else WARM_CALLS), target)
            for part in PARTS
            for cold, target in ((False, part.warm_us), (True, part.cold_us))
        ]
        plan += [(Request(name), target) for name, target in SPEEDS.items()]
        rows, missing = [], []
        for request, target in track(plan, "measuring", console=console, transient=True):
            turns = [[ask(request) for ask in asks] for _ in range(rounds)]
            here, *there = zip(*turns, strict=True)
            row = row_of(request, here, there[0] if there else (), target)
            rows += [] if row is None else [row]
            for tree, answer in zip(("here", f"in {flags.against}"), turns[0], strict=False):
                if answer.missing and not request.cold:
                    missing.append(f"{request.name}: not measured {tree}: {answer.missing}")
    return rows, missing
