"""Says so if another fleet runs on this machine: each drops out for the other's sake."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from tools.fleet import procfs


def warn_of_others(console: Console, own: Path | None = None) -> None:
    """Print a line for each fleet that runs.

    Args:
        console: to print on.
        own: run directory of the fleet that is not another; None: all are.
    """
    for other in sorted(procfs.fleets()):
        if own is None or Path(other) != own:
            console.print(
                f"[yellow]another fleet runs in {other}: two do not fit on two cores, and drives "
                f"of either may be lost; `xrl down --run-dir {other}` stops it[/]",
                soft_wrap=True,
            )
