"""`xrl faults`: what goes wrong, what then happens, and the way out of it."""

from __future__ import annotations

import argparse

import msgspec
from rich.console import Console
from rich.table import Table

from shared.fault_table import DRIVE_FAULTS, LOSSES
from shared.scenario import FAULT_KINDS
from tools.verbs import Subparsers, add_verb

_LABEL_WIDTH = 12


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "faults",
        """
        xrl faults
        xrl faults --json
        xrl sim --fault knee_left:encoder@4     # to see one
        """,
    )
    parser.add_argument("--json", action="store_true", help="print the table as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    if args.json:
        rows = {
            "drive": {kind: row._asdict() for kind, row in DRIVE_FAULTS.items()},
            "fleet": {name: row._asdict() for name, row in LOSSES.items()},
        }
        print(msgspec.json.format(msgspec.json.encode(rows)).decode())
        return 0
    console = Console(highlight=False)
    console.print(
        "[bold]A drive's fault.[/] Its module goes to FAULT, and the planner has the other five "
        "HOLD. An axis that disarms floats; its sibling keeps its torque until the service idles "
        "it, at once. Nothing takes hold again unasked: mend it, then restart the module's "
        "service (`xrl kill MODULE`).\n"
    )
    for kind, row in DRIVE_FAULTS.items():
        limp = "limp" if row.limp else "held"
        console.print(f"[bold]{kind}[/]: {FAULT_KINDS[kind].about}")
        _say(console, "the drive", f"{row.drive} ({limp})")
        _say(console, "because", row.cause.name)
        _say(console, "way out", row.recovery)
    console.print("\n[bold]What else can be lost.[/]\n")
    for name, loss in LOSSES.items():
        console.print(f"[bold]{name}[/]")
        _say(console, "module", loss.module)
        _say(console, "others", loss.others)
        _say(console, "you see", loss.told)
        _say(console, "it ends", loss.recovery)
    return 0


def _say(console: Console, label: str, text: str) -> None:
    """Print one labelled line, wrapped under itself."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=_LABEL_WIDTH, justify="right", style="dim")
    grid.add_column()
    grid.add_row(label, text)
    console.print(grid)
