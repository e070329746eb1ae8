"""The verdict as a table in the terminal."""

from __future__ import annotations

from typing import Final

from rich.table import Table
from rich.text import Text

from tools.judge.standing import BY_KEY, LIMITS, SOUND, VerdictLimit
from tools.judge.verdict import Summary
from tools.terminal import Console, marked

OK: Final = "ok"
OVER: Final = "over"
OF_THE_MACHINE: Final = ("pd_cycles_late_pct", "fleet_cpu_pct", "sequence_gaps")
"""Figures that an impaired link cannot explain."""
STALLS_MAX: Final = 6
"""Maximum number of lines about single stalls."""
NOTHING: Final = 5e-4
"""Smaller values are shown as 0.00; no limit is near them."""


def show(summary: Summary, console: Console) -> None:
    """Print the verdict table."""
    table = Table(title="Verdict", title_justify="left")
    table.add_column("what")
    table.add_column("measured", justify="right")
    table.add_column("limit", justify="right")
    table.add_column("")
    figures = rows(summary)
    for *cells, word in figures:
        colour = "green" if word == OK else "yellow" if word.startswith(OVER) else "default"
        table.add_row(*cells, Text(word, colour))
    console.print(table)
    if summary.sound and any(word.startswith(OVER) for *_, word in figures):
        decide = ", ".join(BY_KEY[key].what for key in SOUND)
        console.print(
            "Figures over their limits are only reported. Only these decide the verdict: standing "
            f"to the end, {decide}.",
            style="dim",
        )
    wearer = [] if summary.wearer is None else [summary.wearer.describe()]
    for line in (*wearer, *stalls(summary), *network(summary)):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if summary.pace != 1.0:
        console.print(
            f"In slow motion: the fleet's clock ran at {summary.pace:g} of real time.",
            style="dim",
            highlight=False,
        )
    if not summary.in_real_time:
        console.print(
            marked(
                "[yellow]The machine was too slow for real time: real-time factor "
                "{:.3f}, {:.2f} s of world "
                "time given up. The times above are not those of a real robot.[/]",
                summary.real_time_factor,
                summary.world_time_lost_s,
            )
        )
    console.print(_sentence(summary))


def rows(summary: Summary) -> list[tuple[str, str, str, str]]:
    """Return figure, measured, limit and mark of each figure that is known.

    After a kill there is always a row for its time to HOLD, with `-` if it was not measured.
    """
    found = []
    for row in LIMITS:
        unit = f" {row.unit}" if row.unit else ""
        limit = f"{row.limit:g}{unit}"
        value: float | None = getattr(summary, row.key)
        if value is not None:
            found.append((row.what, f"{digits(value)}{unit}", limit, mark(row, summary)))
        elif row.key == "handover_max_ms" and summary.handover_ms:
            found.append((row.what, "-", limit, ""))
    return found


def mark(row: VerdictLimit, summary: Summary) -> str:
    """Return the verdict on a figure: `ok`, or `over`, possibly with a reason.

    For messages that a stopped service lost, it is the reason without `over`.
    """
    if getattr(summary, row.key) <= row.limit:
        return OK
    if row.key == "sequence_gaps" and summary.stopped:
        return "of a service that was stopped"
    if row.key in OF_THE_MACHINE:
        return f"{OVER}, a busy machine" if row.key != "sequence_gaps" else OVER
    return f"{OVER}, links impaired" if summary.links_impaired else OVER


def stalls(summary: Summary) -> list[str]:
    """Return a line for each stall that made modules hold, and one line for the other stalls."""
    told = [row.said for row in summary.stalls if row.modules_held]
    rest = [row.lasted_ms for row in summary.stalls if not row.modules_held]
    lines = told[:STALLS_MAX]
    if len(told) > STALLS_MAX:
        lines.append(f"more stalls with consequences: {len(told) - STALLS_MAX}")
    if rest:
        lines.append(f"Stalls of the machine without consequence: {len(rest)}, at most "
                     f"{max(rest):.0f} ms")  # fmt: skip
    if told:
        lines.append("Figures marked led or held exclude the consequences of stalls.")
    return lines


def network(summary: Summary) -> list[str]:
    """Return a line for each impairment: link, impairment, time, messages passed and lost.

    If there is any, one more line compares the command ages during impairments and outside.
    """
    lines = list(summary.impairments)
    ages = [
        f"{digits(age.median)} ms, 99 % within {digits(age.p99)} ms {when}"
        for when, age in (
            ("while impaired", summary.command_age_impaired_ms),
            ("otherwise", summary.command_age_otherwise_ms),
        )
        if age is not None
    ]
    if lines and ages:
        lines.append(f"median age of commands in TRACK: {'; '.join(ages)}")
    return lines


def digits(value: float) -> str:
    """Return a figure with three significant digits, or all before the point: 1540, not 1.54e+03.

    A nonzero value below `NOTHING` is 0.00; zero is 0.
    """
    if abs(value) < NOTHING:
        return "0.00" if value else "0"
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _sentence(summary: Summary) -> Text:
    if summary.sound:
        return marked("[bold green]STOOD[/] for {:.1f} s", summary.duration_s)
    if not summary.began:
        return marked(
            "[bold red]FELL[/] {:.1f} s after the hoist released it, before the scenario started",
            summary.fallen_at_s,
        )
    if summary.fallen_at_s is not None:
        return marked("[bold red]FELL[/] at {:.1f} s", summary.fallen_at_s)
    if summary.why_not:
        return marked("[bold red]DOES NOT STAND[/] at the end: {}", summary.why_not)
    if summary.unsound:
        return marked("[bold red]STOOD, BUT NOT SOUNDLY[/]: {}", summary.unsound)
    return marked("[bold red]NOT FINISHED[/]: the log ends at {:.1f} s", summary.duration_s)
