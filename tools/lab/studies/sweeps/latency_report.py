"""The latency study as text, and its pictures: falls, and the hand's effort."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import median
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from rich.table import Table

from shared.extras import late
from tools.lab.studies.sweeps.latency_trial import CONTROLS, DURATION_S, PUSHES
from tools.lab.studies.sweeps.push_range import SHARE
from tools.lab.studies.sweeps.report import parted, wilson
from tools.lab.studies.sweeps.study import StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.output import Picture, new_figure
from tools.terminal import marked

if TYPE_CHECKING:
    from matplotlib import colors
else:
    colors = late("matplotlib.colors")

WORST: Final = (
    ("com_max_mm", "COM {:.0f} mm off"),
    ("torque_step_nm", "torque steps to {:.0f} N m in 4 ms"),
    ("hold_step_nm", "{:.1f} N m at HOLD"),
)
"""Column, and in words."""
LISTED: Final = 6
"""Values in a title; of more the first two and the last."""

HOLDS: Final = 0.1
"""With a larger share of the time in HOLD, a robot does not follow the hand."""
DPI: Final = 120
SHARES_IN: Final = 2.7
"""Height of the curves, inches."""
BOUNDS_COLUMNS: Final = 8
"""In a map of more delays a cell has room for falls and trials only."""
COUNTS_COLUMNS: Final = 24
"""In a map of more delays a cell has room for no number."""


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


def show(finished: StudyRun) -> None:
    """Print what came of the study."""
    rows, console = finished.rows, finished.console
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
            again = f"{finished.command} --only {first['number']}"
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


class LineStyle(NamedTuple):
    """Line style of a control; distinguishable without colour."""

    colour: str
    marker: str
    shift: float
    """Offset of a delay's place, so that nothing hides another."""


STYLES: Final = {
    "distributed": LineStyle("#1b7f4b", "o", -0.12),
    "diagonal": LineStyle("#c77700", "s", 0.0),
    "centralised": LineStyle("#7b3fa0", "^", 0.12),
}


def _shares() -> colors.Colormap:
    """Return colours from none fell to all fell."""
    return colors.LinearSegmentedColormap.from_list("falls", ["#e3f1e7", "#f2b7a0", "#b3261e"])


def draw_falls(finished: StudyRun) -> Picture:
    """Draw who falls: a map for each control, and their shares by delay."""
    rows, what = finished.rows, f"seed {finished.flags.seed}"
    names = controls_in(rows)
    map_in = 0.5 + 0.26 * min(len(values_in(rows, "loss")), 12)
    height = 1.0 + (map_in + 0.2) * len(names) + SHARES_IN
    figure = new_figure(7.5, height, dpi=DPI)
    grid = figure.add_gridspec(len(names) + 1, 1, height_ratios=[map_in] * len(names) + [SHARES_IN])
    for index, name in enumerate(names):
        axis = figure.add_subplot(grid[index])
        _draw_map(axis, rows, name)
    axis.set_xlabel("delay each way in ms", fontsize=9)
    _draw_shares(figure.add_subplot(grid[-1]), rows)
    figure.suptitle(
        f"Who falls: {len(rows)} runs of {DURATION_S:g} s, led by hand; {what}; {PUSHES} pushes "
        f"in each,\nup to {SHARE:.0%} of what soles and motors bear; all links get bad, both ways, "
        "on the way down.\nCells: falls/trials, 95 % interval of the share (Wilson)",
        fontsize=10, x=0.01, ha="left",
    )  # fmt: skip
    return figure


def _draw_map(axis: Any, rows: Sequence[Row], name: str) -> None:
    """Share of falls over delay and loss; in each cell falls, trials, and the share's bounds."""
    delays, losses = values_in(rows, "delay_ms"), values_in(rows, "loss")
    cells = [
        [falls(chosen(rows, name, delay_ms=delay, loss=loss)) for delay in delays]
        for loss in losses
    ]
    shares = [[cell.fallen / cell.of if cell.of else math.nan for cell in line] for line in cells]
    axis.imshow(shares, cmap=_shares(), vmin=0.0, vmax=1.0, origin="lower", aspect="auto")
    for y, line in enumerate(cells):
        for x, cell in enumerate(line):
            if cell.of:
                axis.text(
                    x, y, _in_cell(cell, len(delays)), ha="center", va="center", fontsize=7.5,
                    color="white" if cell.fallen > 0.7 * cell.of else "#333333",
                )  # fmt: skip
    whole = falls(chosen(rows, name))
    title = f"{name}: {whole.fallen} of {whole.of} fell"
    if len(jitters := values_in(rows, "jitter_ms")) > 1:
        title += f"; {', '.join(f'{jitter:g}' for jitter in jitters)} ms of jitter together"
    if len(delays) > BOUNDS_COLUMNS:
        none = Falls(0, max(cell.of for line in cells for cell in line))
        title += f"; none of {none.of} is {none.describe_bounds}"
    axis.set_title(title, fontsize=10)
    for between in range(1, len(delays)):
        axis.axvline(between - 0.5, color="white", lw=0.8)
    for between in range(1, len(losses)):
        axis.axhline(between - 0.5, color="white", lw=0.8)
    axis.set_xticks(range(len(delays)), [f"{delay:g}" for delay in delays], fontsize=8)
    axis.set_yticks(range(len(losses)), [f"{100 * loss:g}" for loss in losses], fontsize=8)
    axis.set_ylabel("% lost", fontsize=9)


def _in_cell(cell: Falls, columns: int) -> str:
    """Return as much as there is room for."""
    if columns > COUNTS_COLUMNS:
        return ""
    count = f"{cell.fallen}/{cell.of}"
    return count if columns > BOUNDS_COLUMNS else f"{count}   {cell.describe_bounds}"


def _draw_shares(axis: Any, rows: Sequence[Row]) -> None:
    """Share of falls over the delay, all losses together, with its 95 % band."""
    delays = values_in(rows, "delay_ms")
    for name in controls_in(rows):
        style = STYLES[name]
        counted = [falls(chosen(rows, name, delay_ms=delay)) for delay in delays]
        places = [x + style.shift for x, count in enumerate(counted) if count.of]
        counted = [count for count in counted if count.of]
        shares = np.array([100 * count.fallen / count.of for count in counted])
        low, high = 100 * np.transpose([count.bounds for count in counted])
        axis.fill_between(places, low, high, color=style.colour, alpha=0.13, lw=0)
        spread = np.maximum(0.0, (shares - low, high - shares))
        axis.errorbar(
            places, shares, yerr=spread, color=style.colour, marker=style.marker, ms=6, lw=1.6,
            elinewidth=1.2, capsize=3, label=name,
        )  # fmt: skip
    axis.set_xticks(range(len(delays)), [f"{delay:g}" for delay in delays], fontsize=8)
    axis.set_ylim(-3.0, 103.0)
    axis.tick_params("y", labelsize=8)
    axis.set_xlabel("delay each way in ms (not to scale)", fontsize=9)
    axis.set_ylabel("falls in %", fontsize=9)
    axis.set_title(f"All of this mix together: {mix(rows)}; {_each(rows)}", fontsize=10)
    axis.legend(fontsize=9, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.17), frameon=False)
    axis.grid(visible=True, lw=0.3)


def _each(rows: Sequence[Row]) -> str:
    """Return how many trials a point of the curves has."""
    counts = {
        falls(chosen(rows, name, delay_ms=delay)).of
        for name in controls_in(rows)
        for delay in values_in(rows, "delay_ms")
    } - {0}
    some = f"{max(counts)}" if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
    return f"{some} trials a point"


def draw_effort(finished: StudyRun) -> Picture:
    """Draw the hand's force and the time in HOLD by delay, with the least loss."""
    rows, what = without_loss(finished.rows), f"seed {finished.flags.seed}"
    force_max = finished.robot.simulation.operator.force_max
    figure = new_figure(7.5, 6.0, dpi=DPI)
    effort, hold = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    delays = values_in(rows, "delay_ms")
    for name in controls_in(rows):
        _draw_control(effort, hold, rows, name)
    grey = {"color": "#777777", "ls": ""}
    effort.plot([], [], marker="o", ms=6, mfc="white", label="held for over 10 %", **grey)
    effort.plot([], [], marker="x", ms=8, mew=2, label="some fell", **grey)
    effort.axhline(force_max, color="#999999", lw=0.8, ls=":")
    effort.set_ylim(0.0, 1.08 * force_max)
    effort.set_ylabel("hand's peak force in N")
    effort.set_title(
        f"Median, least and most; the hand gives at most {force_max:g} N; up to the fall, if any",
        fontsize=10,
    )
    hold.legend(
        *effort.get_legend_handles_labels(), fontsize=9, ncols=5, loc="upper center",
        bbox_to_anchor=(0.47, -0.38), frameon=False, columnspacing=1.0,
    )  # fmt: skip
    hold.set_ylim(-4.0, 104.0)
    hold.set_ylabel("time in HOLD in %")
    hold.set_title("A robot that holds stands, and does not follow the hand", fontsize=10)
    hold.set_xticks(range(len(delays)), [f"{delay:g}" for delay in delays])
    hold.set_xlabel("delay each way in ms (not to scale)")
    for axis in (effort, hold):
        axis.grid(visible=True, lw=0.3)
    figure.suptitle(
        f"What the hand meets: squats under {PUSHES} pushes; {mix(rows)}; {len(rows)} runs, {what}",
        fontsize=11, x=0.01, ha="left",
    )  # fmt: skip
    return figure


def _draw_control(effort: Any, hold: Any, rows: Sequence[Row], name: str) -> None:
    style = STYLES[name]
    line = {"color": style.colour, "lw": 1.6}
    held: list[tuple[float, float]] = []
    points: list[tuple[float, float, float, float]] = []
    for x, delay in enumerate(values_in(rows, "delay_ms")):
        own = chosen(rows, name, delay_ms=delay)
        forces, shares = figures(own, "operator_peak_n"), figures(own, "hold_share")
        if not forces:
            continue
        place, middle, share = x + style.shift, median(forces), median(shares)
        points.append((place, min(forces), middle, max(forces)))
        held.append((place, 100 * share))
        face = "white" if share > HOLDS else style.colour
        effort.plot(place, middle, style.marker, ms=6, mfc=face, color=style.colour, zorder=4)
        if falls(own).fallen:
            effort.plot(place, middle, "x", color="#222222", ms=9, mew=1.8, zorder=5)
    if not points:
        return
    places, low, middles, high = zip(*points, strict=True)
    effort.fill_between(places, low, high, color=style.colour, alpha=0.15, lw=0)
    effort.plot(places, middles, label=name, marker=style.marker, ms=6, **line)
    hold.plot(*zip(*held, strict=True), marker=style.marker, ms=6, **line)
