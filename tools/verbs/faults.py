"""`xrl faults`: what goes wrong, what then happens, and the way out of it."""

from __future__ import annotations

from typing import Final

import msgspec
from rich.table import Table

from shared.config.files import load
from shared.config.scenarios import FAULT_KINDS
from shared.config.sections import TripLimit
from shared.robot.fault_table import DRIVE_FAULTS, LOSSES
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS, TripRow
from tools.flags import ConfigFlags
from tools.terminal import Console, marked

_LABEL_WIDTH = 12


EXAMPLES: Final = """
xrl faults
xrl faults --json
xrl sim --fault knee_left:encoder@4     # to see one
"""


class FaultsFlags(ConfigFlags):
    """Whose limits, and in which form."""

    json: bool = False
    """print the table as JSON"""


def run(flags: FaultsFlags) -> int:
    """Print the table."""
    limits = load(flags.config).trips
    trips = {
        trip.name: (row, getattr(limits, row.key))
        for trip, row in (*JOINT_TRIPS.items(), *PLANNER_TRIPS.items())
    }
    if flags.json:
        rows = {
            "drive": {kind: row._asdict() for kind, row in DRIVE_FAULTS.items()},
            "fleet": {name: row._asdict() for name, row in LOSSES.items()},
            "trips": {
                name: row._asdict() | msgspec.to_builtins(limit)
                for name, (row, limit) in trips.items()
            },
        }
        print(msgspec.json.format(msgspec.json.encode(rows)).decode())
        return 0
    console = Console(highlight=False)
    console.print(
        marked(
            "[bold]A drive's fault.[/] Once it is noticed its module goes to FAULT, and the "
            "planner has the other five HOLD. An axis that disarms floats; its sibling keeps its "
            "torque until the service idles it, at once. Nothing is re-armed automatically: remove "
            "the cause, then restart the module's service (`xrl kill MODULE`).\n"
        )
    )
    for kind, row in DRIVE_FAULTS.items():
        limp = "limp" if row.limp else "held"
        console.print(marked("[bold]{}[/]: {}", kind, FAULT_KINDS[kind].about))
        _say(console, "the drive", f"{row.drive} ({limp})")
        _say(console, "because", row.cause.name if row.cause else "no FAULT: it stays in control")
        _say(console, "way out", row.recovery)
    console.print(marked("\n[bold]What else can be lost.[/]\n"))
    for name, loss in LOSSES.items():
        console.print(marked("[bold]{}[/]", name))
        _say(console, "module", loss.module)
        _say(console, "others", loss.others)
        _say(console, "you see", loss.visible)
        _say(console, "it ends", loss.recovery)
    console.print(
        marked(
            "\n[bold]Trips.[/] Each module and the planner check these while the planner leads: "
            "all six HOLD. The planner leads again after a wait that grows with each trip.\n"
        )
    )
    for name, (trip, limit) in trips.items():
        console.print(marked("[bold]{}[/]: {}", name, trip.measured))
        _say(console, "trips", _describe_limit(trip, limit))
        _say(console, "you do", trip.recovery)
    return 0


def _describe_limit(row: TripRow, limit: TripLimit) -> str:
    beyond = "below" if row.least else "above"
    lasting = f" for {limit.after_ms:g} ms" if limit.after_ms else ""
    return f"{beyond} {limit.limit:g} {row.unit}{lasting} (trips.{row.key})"


def _say(console: Console, label: str, text: str) -> None:
    """Print one labelled line, wrapped under itself."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=_LABEL_WIDTH, justify="right", style="dim")
    grid.add_column()
    grid.add_row(label, text)
    console.print(grid)
