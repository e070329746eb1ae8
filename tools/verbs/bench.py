"""`xrl bench`: what each part of the fleet costs here; its bus and the whole fleet are beside it.

Absolute times of a busy machine say little. Two versions are compared by `--against`, which runs
both in turn, or by the ratio of each figure to a yardstick that ran beside it.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Final

from rich.progress import track
from rich.text import Text

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.exceptions import FAULT_EXIT_CODE
from shared.extras import require
from shared.places import CHECKOUT
from tools.lab.bench import bus as bus_bench
from tools.lab.bench import fleet as fleet_bench
from tools.lab.bench import revisions
from tools.lab.bench.parts import LOCKSTEP, LOCKSTEP_RECORDED, PARTS
from tools.lab.bench.revisions import Worker, its_config
from tools.lab.bench.table import AgainstFlags, print_table, ratio_cell, write_rows
from tools.lab.bench.timing import ASLEEP_S, SWEPT_BYTES, YARDSTICK_CALLS
from tools.lab.bench.worker import READY, PartRow, Request, row_of
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
    rows, missing = measure(flags.config.resolve(), flags.against, flags.rounds or ROUNDS, console)
    compare = ("wall", "/ yard") if flags.against is None else (flags.against, "ratio")
    print_table(
        console,
        ("", "CPU", *compare, "target"),
        [_cells(row, flags.against) for row in rows],
        "Medians of the rounds' medians, us; CPU is the calling thread's. "
        f"Cold: {SWEPT_BYTES >> 20} MiB are swept and {1e3 * ASLEEP_S:g} ms slept before a call. "
        f"Yardstick: {YARDSTICK_CALLS} solutions of a 12 x 12 system in NumPy.",
    )
    for line in missing:
        console.print(marked("[yellow]{}[/]", line))
    write_rows(flags.json, [row.as_dict() for row in rows])
    return FAULT_EXIT_CODE if flags.strict and not all(part.row.ok for part in rows) else 0


def measure(
    config: Path, against: str | None, rounds: int, console: Console
) -> tuple[list[PartRow], list[str]]:
    """Return the table's rows, and what could not be measured.

    A git revision to compare `against` measures in turn with this tree, and takes its own version
    of a robot file in this checkout.
    """
    with ExitStack() as stack:
        other = None if against is None else stack.enter_context(revisions.unpacked(against))
        workers = [stack.enter_context(Worker(CHECKOUT, config))]
        if other is not None:
            workers.append(stack.enter_context(Worker(other, its_config(config, other))))
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
            row = row_of(request, here, there[0] if there else (), target)
            rows += [] if row is None else [row]
            for tree, answer in zip(("here", f"in {against}"), turns[0], strict=False):
                if answer.missing and not request.cold:
                    missing.append(f"{request.name}: not measured {tree}: {answer.missing}")
    return rows, missing


def _cells(part: PartRow, against: str | None) -> list[Text | str]:
    row = part.row
    cells: list[Text | str] = [row.what, f"{_number(row.value)} {row.unit}"]
    if against is None:
        cells += [_number(part.wall), _number(part.to_yardstick)]
    else:
        cells += [_number(row.other), ratio_cell(row)]
    return [*cells, row.marked_target()]


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
