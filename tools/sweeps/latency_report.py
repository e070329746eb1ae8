"""The latency study in words, and what its pictures are drawn from."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Final, NamedTuple

from rich.console import Console
from rich.table import Table

from tools.sweeps.latency_trial import CONTROLS
from tools.sweeps.outcome import Ending
from tools.sweeps.report import wilson
from tools.sweeps.table import Row

WORST: Final = (
    ("com_max_mm", "COM {:.0f} mm off"),
    ("torque_step_nm", "torque steps to {:.0f} N m in 4 ms"),
    ("hold_step_nm", "{:.1f} N m at HOLD"),
)
"""Column, and in words."""


class Falls(NamedTuple):
    """Falls among some trials."""

    fallen: int
    of: int

    @property
    def bounds(self) -> tuple[float, float]:
        """Of the share, 95 %, Wilson."""
        return wilson(self.fallen, self.of)


def controls_in(rows: Sequence[Row]) -> list[str]:
    """Return the controls that were compared, in the order of their table."""
    there = {row["control"] for row in rows}
    return [name for name in CONTROLS if name in there]


def values_in(rows: Sequence[Row], column: str) -> list[float]:
    """Return what a column holds, rising."""
    return sorted({float(row[column]) for row in rows})


def chosen(rows: Sequence[Row], control: str, **where: float) -> list[Row]:
    """Return the trials of a control in which columns have these values."""
    return [
        row
        for row in rows
        if row["control"] == control
        and all(float(row[column]) == value for column, value in where.items())
    ]


def falls(rows: Sequence[Row]) -> Falls:
    """Count the trials that did not stand to the end."""
    return Falls(sum(row["ending"] != Ending.STOOD for row in rows), len(rows))


def without_loss(rows: Sequence[Row]) -> list[Row]:
    """Return the trials with the least jitter and the least loss of the study."""
    jitter, loss = (values_in(rows, column)[0] for column in ("jitter_ms", "loss"))
    return [row for row in rows if (float(row["jitter_ms"]), float(row["loss"])) == (jitter, loss)]


def figures(rows: Sequence[Row], column: str) -> list[float]:
    """Return a column's numbers, where there are any."""
    return [float(row[column]) for row in rows if row[column]]


def show(rows: Sequence[Row], command: str, console: Console) -> None:
    """Print what came of the study.

    Args:
        rows: of the table.
        command: that runs one trial alone, but for the trial's number.
        console: to print on.
    """
    console.print(_table(rows))
    for name in controls_in(rows):
        own = chosen(rows, name)
        counted = falls(own)
        delay, worst_there = _worst_delay(own)
        low, high = (100 * bound for bound in worst_there.bounds)
        colour = "red" if counted.fallen else "green"
        console.print(
            f"[bold]{name}[/]: [{colour}]{counted.fallen} of {counted.of} fell[/]; at {delay:g} ms "
            f"{worst_there.fallen} of {worst_there.of}: {low:.0f} to {high:.0f} % (95 %, Wilson)",
            highlight=False,
        )
        standing = [row for row in own if row["ending"] == Ending.STOOD]
        if standing:
            worst = [words.format(max(figures(standing, key))) for key, words in WORST]
            console.print(f"  standing: {', '.join(worst)}", highlight=False)
        if first := next((row for row in own if row["ending"] != Ending.STOOD), None):
            again = f"{command} --only {first['number']}"
            console.print(f"  {first['ending']}: {again}", style="dim", soft_wrap=True)


def _worst_delay(rows: Sequence[Row]) -> tuple[float, Falls]:
    """Return the delay with the largest share of falls, and its falls.

    Trials at one delay are independent; those at different delays are not, so that all of
    them together have no bounds.
    """
    found = [
        (delay, falls([row for row in rows if float(row["delay_ms"]) == delay]))
        for delay in values_in(rows, "delay_ms")
    ]
    return max(found, key=lambda pair: pair[1].fallen / pair[1].of)


def _table(rows: Sequence[Row]) -> Table:
    """Return falls of all trials, and what the hand met without loss, by delay."""
    quiet = without_loss(rows)
    names = controls_in(rows)
    loss = 100 * float(quiet[0]["loss"])
    table = Table(
        title=f"Falls; hand and HOLD at {loss:g} % lost",
        title_justify="left",
    )
    table.add_column("delay\nms", justify="right")
    for name in names:
        table.add_column(f"{name}\n fell   hand HOLD", justify="right")
    for delay in values_in(rows, "delay_ms"):
        cells = []
        for name in names:
            fell = "{}/{}".format(*falls(chosen(rows, name, delay_ms=delay)))
            own = chosen(quiet, name, delay_ms=delay)
            hand = _median(own, "operator_peak_n", "{:.0f} N")
            hold = _median(own, "hold_share", "{:.0f} %", 100.0)
            cells.append(f"{fell:>5} {hand:>6} {hold:>5}")
        table.add_row(f"{delay:g}", *cells)
    return table


def _median(rows: Sequence[Row], column: str, text: str, scale: float = 1.0) -> str:
    known = figures(rows, column)
    return text.format(scale * median(known)) if known else ""
