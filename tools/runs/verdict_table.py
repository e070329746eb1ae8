"""The verdict for people: one table in the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from tools.runs.verdict import LIMITS, Summary


def show(summary: Summary, console: Console) -> None:
    """Print the verdict table."""
    table = Table(title="Verdict", title_justify="left")
    table.add_column("what")
    table.add_column("measured", justify="right")
    table.add_column("limit", justify="right")
    table.add_column("")
    for row in LIMITS:
        value = summary.get(row.key)
        if value is None:
            continue
        good = value <= row.limit
        mark = "[green]ok[/]" if good else "[yellow]over[/]"
        if row.key == "sequence_gaps" and not good and summary["stopped"]:
            mark = "of a service that was stopped"
        unit = f" {row.unit}" if row.unit else ""
        table.add_row(row.what, f"{_three_digits(value)}{unit}", f"{row.limit:g}{unit}", mark)
    console.print(table)
    if not summary["in_real_time"]:
        console.print(
            f"[yellow]The machine was too slow for real time: real-time factor "
            f"{summary['real_time_factor']:.3f}, {summary['world_time_lost_s']:.2f} s of world "
            f"time given up. The times above are not those of a robot.[/]"
        )
    console.print(_sentence(summary))


def _three_digits(value: float) -> str:
    """Return a figure with three digits, or all before the point: 1540, not 1.54e+03."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _sentence(summary: Summary) -> str:
    if summary["stood"]:
        return f"[bold green]STOOD[/] for {summary['duration_s']:.1f} s"
    if not summary["began"]:
        return (
            f"[bold red]FELL[/] {summary['fallen_at_s']:.1f} s after the hoist let go, before the "
            "scenario began"
        )
    if summary["fallen_at_s"] is not None:
        return f"[bold red]FELL[/] at {summary['fallen_at_s']:.1f} s"
    return f"[bold red]NOT FINISHED[/]: the log ends at {summary['duration_s']:.1f} s"
