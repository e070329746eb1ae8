"""Says so if another fleet runs on this machine: each drops out for the other's sake."""

from __future__ import annotations

from pathlib import Path

from tools.fleet import procfs
from tools.terminal import Console, marked


def warn_of_others(console: Console, own: Path | None = None) -> None:
    """Print a line for each fleet that runs.

    Args:
        console: to print on.
        own: run directory of the fleet that is not another; None: all are.
    """
    for other in sorted(procfs.fleets()):
        if own is None or Path(other) != own:
            console.print(
                marked(
                    "[yellow]another fleet runs in {}: two do not fit on two cores, and drives "
                    "of either may be lost; `xrl down --run-dir {}` stops it[/]",
                    other,
                    other,
                ),
                soft_wrap=True,
            )
