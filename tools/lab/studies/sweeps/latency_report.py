"""The latency study as text, and the data of its pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import Final, NamedTuple

from rich.table import Table

from tools.lab.studies.sweeps.latency_trial import CONTROLS
from tools.lab.studies.sweeps.report import parted, wilson
from tools.lab.studies.sweeps.table import Row
from tools.terminal import Console, marked

WORST: Final = (
    ("com_max_mm", "COM {:.0f} mm off"),
    ("torque_step_nm", "torque steps to {:.0f} N m in 4 ms"),
    ("hold_step_nm", "{:.1f} N m at HOLD"),
)
"""Column, and in words."""
LISTED: Final = 6
"""Values in a title; of more the first two and the last."""


class Falls(NamedTuple):
    """Falls among some trials."""

    fallen: int
    of: int

    @property
    def bounds(self) -> tuple[float, float]:
        """Return the 95 % interval of the share (Wilson), over the mix of losses or jitters."""
        return wilson(self.fallen, self.of)

    @property
    def describe_bounds(self) -> str:
        """The bounds in %."""
        low, high = self.bounds
        return f"{100 * low:.0f}-{100 * high:.0f} %"


def controls_in(rows: Sequence[Row]) -> list[str]:
    """Return the controls that were compared, in the order of their table."""
    there = {row["control"] for row in rows}
    return [name for name in CONTROLS if name in there]


def values_in(rows: Sequence[Row], column: str) -> list[float]:
    """Return the values of a column, sorted."""
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
    return Falls(len(parted(rows)[1]), len(rows))


def without_loss(rows: Sequence[Row]) -> list[Row]:
    """Return the trials with the least jitter and the least loss of the study."""
    jitter, loss = (values_in(rows, column)[0] for column in ("jitter_ms", "loss"))
    return [row for row in rows if (float(row["jitter_ms"]), float(row["loss"])) == (jitter, loss)]


def figures(rows: Sequence[Row], column: str) -> list[float]:
    """Return a column's numbers, where there are any."""
    return [row[column] for row in rows if row[column] is not None]


def mix(rows: Sequence[Row]) -> str:
    """Return the differences of trials at one delay as text, apart from random draws."""
    losses = [100 * loss for loss in values_in(rows, "loss")]
    words = f"{_listed(losses)} % lost"
    jitters = values_in(rows, "jitter_ms")
    return words if jitters == [0.0] else f"{words}, {_listed(jitters)} ms of jitter"


def _listed(values: Sequence[float]) -> str:
    words = [f"{value:g}" for value in values]
    return ", ".join(words if len(words) <= LISTED else [*words[:2], "...", words[-1]])


def show(rows: Sequence[Row], command: str, console: Console) -> None:
    """Print what came of the study; `command` and a number run one trial alone."""
    console.print(_falls_table(rows))
    console.print(_lead_table(rows))
    for name in controls_in(rows):
        own = chosen(rows, name)
        counted = falls(own)
        words = marked("[bold]{}[/]: [green]none of {} fell[/]", name, counted.of)
        if counted.fallen:
            delay, there = _worst_delay(own)
            words = marked(
                "[bold]{}[/]: [red]{} of {} fell[/]; most at {:g} ms, {} of {}",
                name,
                counted.fallen,
                counted.of,
                delay,
                there.fallen,
                there.of,
            )
        console.print(words, highlight=False)
        standing, fallen = parted(own)
        if standing:
            worst = [words.format(max(figures(standing, key))) for key, words in WORST]
            console.print(f"  standing: {', '.join(worst)}", highlight=False)
        for first in fallen[:1]:
            again = f"{command} --only {first['number']}"
            console.print(f"  {first['ending']}: {again}", style="dim", soft_wrap=True)


def _worst_delay(rows: Sequence[Row]) -> tuple[float, Falls]:
    """Return the delay with the largest fraction of falls, and its falls.

    Its confidence bounds would be too narrow, because the delay was selected by its falls.
    """
    found = [
        (delay, falls([row for row in rows if float(row["delay_ms"]) == delay]))
        for delay in values_in(rows, "delay_ms")
    ]
    return max(found, key=lambda pair: pair[1].fallen / pair[1].of)


def _falls_table(rows: Sequence[Row]) -> Table:
    """Return the falls at each delay, with the bounds of their share."""
    what = f"Falls, 95 % of their share (Wilson) in this mix: {mix(rows)}"

    def cell(own: Sequence[Row]) -> str:
        fell = falls(own)
        return f"{fell.fallen} of {fell.of} {fell.describe_bounds:>9}" if fell.of else ""

    return _by_delay(what, rows, cell)


def _lead_table(rows: Sequence[Row]) -> Table:
    """Return the hand's effort at each delay, with the smallest loss."""
    quiet = without_loss(rows)
    what = f"Hand's peak force, time in HOLD; medians; {mix(quiet)}"

    def cell(own: Sequence[Row]) -> str:
        hand = _median(own, "operator_peak_n", "{:.0f} N")
        return f"{hand} {_median(own, 'hold_share', '{:.0f} %', 100.0):>6}"

    return _by_delay(what, quiet, cell)


def _by_delay(title: str, rows: Sequence[Row], cell: Callable[[Sequence[Row]], str]) -> Table:
    table = Table(title=title, title_justify="left")
    names = controls_in(rows)
    table.add_column("delay ms", justify="right")
    for name in names:
        table.add_column(name, justify="right")
    for delay in values_in(rows, "delay_ms"):
        cells = [cell(chosen(rows, name, delay_ms=delay)) for name in names]
        table.add_row(f"{delay:g}", *cells)
    return table


def _median(rows: Sequence[Row], column: str, text: str, scale: float = 1.0) -> str:
    known = figures(rows, column)
    return text.format(scale * median(known)) if known else ""
