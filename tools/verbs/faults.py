"""`xrl faults`: lists faults, their effects and how to recover."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import msgspec
from rich.table import Table

from shared.config.files import load
from shared.config.scenarios import FAULT_KINDS
from shared.config.sections import TripLimit, TripsConfig
from shared.robot.fault_table import DRIVE_FAULTS, LOSSES
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS, TripRow
from tools.flags import ConfigFlags
from tools.terminal import Console, marked

_LABEL_WIDTH = 12


EXAMPLES: Final = """
xrl faults
xrl sim --fault knee_left:encoder@4     # reproduce one
"""


class _FaultSection(NamedTuple):
    """Table of faults for the terminal and the reference page."""

    title: str
    about: str
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]
    """Cells of each row, beginning with the name."""


class FaultsFlags(ConfigFlags):
    """Robot whose limits are shown, and the output format."""

    json: bool = False
    """print JSON"""


def run(flags: FaultsFlags) -> int:
    """Print the tables."""
    limits = load(flags.config).trips
    if flags.json:
        trips = {trip.name: row for trip, row in (*JOINT_TRIPS.items(), *PLANNER_TRIPS.items())}
        rows = {
            "drive": {kind: row._asdict() for kind, row in DRIVE_FAULTS.items()},
            "fleet": {name: row._asdict() for name, row in LOSSES.items()},
            "trips": {
                name: row._asdict() | msgspec.to_builtins(getattr(limits, row.key))
                for name, row in trips.items()
            },
        }
        print(msgspec.json.format(msgspec.json.encode(rows)).decode())
        return 0
    console = Console(highlight=False)
    for title, about, headings, found in sections(limits):
        console.print(marked("\n[bold]{}.[/] {}\n", title, " ".join(about.split())))
        for name, *cells in found:
            console.print(marked("[bold]{}[/]", name))
            grid = Table.grid(padding=(0, 1))  # labels, and texts that wrap in their own column
            grid.add_column(width=_LABEL_WIDTH, justify="right", style="dim")
            grid.add_column()
            for label, cell in zip(headings[1:], cells, strict=True):
                grid.add_row(label, cell)
            console.print(grid)
    return 0


def sections(limits: TripsConfig) -> Iterator[_FaultSection]:
    """Yield the tables of drive faults, losses and trips."""
    yield _FaultSection(
        "Drive faults",
        """\
Unless the row says "no FAULT", the module goes to FAULT, and the planner holds the other five. An
axis that disarms floats; the service then idles the module's other axis at once. Nothing is
re-armed automatically: a person removes the cause, then restarts the module's service
(`xrl kill MODULE`).
To reproduce a fault: `xrl sim --fault knee_left:encoder@4`.""",
        ("fault", "meaning", "drive", "limp", "zero lost", "cause", "what to do"),
        [
            (
                kind, FAULT_KINDS[kind].about, row.drive, "yes" if row.limp else "no",
                "yes" if row.zero_lost else "no", row.cause.name if row.cause else "no FAULT",
                row.recovery,
            )
            for kind, row in DRIVE_FAULTS.items()
        ],
    )  # fmt: skip
    yield _FaultSection(
        "A lost process or link, and the emergency stop",
        '"Module" is the affected module, or all six; "others" are the rest and the planner.',
        ("lost", "module", "others", "you see", "recovery"),
        [(name, *loss) for name, loss in LOSSES.items()],
    )
    trips = [(cause.name, "the module", row) for cause, row in JOINT_TRIPS.items()]
    trips += [(number.name, "the planner", row) for number, row in PLANNER_TRIPS.items()]
    yield _FaultSection(
        "Trips",
        """\
On a trip all six modules go to HOLD. The planner leads again after a wait that grows with each
trip. After a trip that the planner detected, all its values must first stay within their limits for
a second.""",
        ("trip", "detected by", "condition", "limit", "what to do"),
        [
            (name, by, row.measured, _limit(row, getattr(limits, row.key)), row.recovery)
            for name, by, row in trips
        ],
    )


def _limit(row: TripRow, limit: TripLimit) -> str:
    beyond = "below" if row.least else "above"
    lasting = f" for {limit.after_ms:g} ms" if limit.after_ms else ""
    return f"{beyond} {limit.limit:g} {row.unit}{lasting} (trips.{row.key})"
