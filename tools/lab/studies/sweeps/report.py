"""What the studies' reports have alike: falls and their share, and predictions that came true."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from rich.table import Table as Printed

from tools.lab.studies.sweeps.figures import Ending
from tools.lab.studies.sweeps.table import Row
from tools.output import Picture, new_figure
from tools.terminal import Console, marked

FALLS_SHOWN: Final = 10
Z_95: Final = 1.959964
"""Two-sided 95 % of a normal distribution, in standard deviations."""
FALL_COLOUR: Final = "#c0392b"


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a share that was seen in some trials (E. B. Wilson, 1927).

    It is one share's: of several intervals, the worst is missed more often than once in 20.

    Args:
        hits: how often it was so.
        of: trials, independent of each other; at least 1.
    """
    share, z2 = hits / of, Z_95 * Z_95
    middle = (share + z2 / (2 * of)) / (1.0 + z2 / of)
    half = Z_95 / (1.0 + z2 / of) * math.sqrt(share * (1.0 - share) / of + z2 / (4 * of * of))
    return max(0.0, middle - half), min(1.0, middle + half)


def parted(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Return the cases that stood to the end, and the others."""
    standing = [row for row in rows if row["ending"] is Ending.STOOD]
    return standing, [row for row in rows if row["ending"] is not Ending.STOOD]


def show_falls(
    fallen: Sequence[Row], command: str, describe: Callable[[Row], str], console: Console
) -> None:
    """Print each case that did not stand, with the command that runs it alone."""
    for row in fallen[:FALLS_SHOWN]:
        console.print(marked("[red]{}[/] {}", row["ending"], describe(row)), highlight=False)
        console.print(f"    {command} --only {row['number']}", style="dim", soft_wrap=True)
    if len(fallen) > FALLS_SHOWN:
        console.print(f"... and {len(fallen) - FALLS_SHOWN} more in the table")


def show_figures(
    rows: Sequence[Row],
    figures: Iterable[tuple[str, str, str]],
    statistics: Mapping[str, Callable[[Sequence[float]], float]],
    console: Console,
) -> None:
    """Print statistics of the trials that stood.

    Args:
        rows: of these trials.
        figures: column, in words, and unit; one that no row has is left out.
        statistics: by heading.
        console: where to.
    """
    printed = Printed("what", *statistics, "", title="Standing trials", title_justify="left")
    for column, words, unit in figures:
        if values := [row[column] for row in rows if row[column] is not None]:
            cells = (f"{statistic(values):.3g}" for statistic in statistics.values())
            printed.add_row(words, *cells, unit)
    console.print(printed)


def show_share(fallen: int, of: int, console: Console) -> None:
    """Print how many fell, and the bounds of their share."""
    low, high = wilson(fallen, of)
    colour = "red" if fallen else "green"
    text = (
        f"[bold {colour}]{{}} falls of {{}}[/]; share of falls {{:.2f}} to {{:.2f}} % "
        "(95 %, Wilson)"
    )
    console.print(marked(text, fallen, of, 100 * low, 100 * high), highlight=False)


def draw_predictions(
    groups: Mapping[str, Sequence[tuple[float, float]]],
    labels: tuple[str, str],
    title: str,
) -> Picture:
    """Draw what was measured over what was predicted.

    Args:
        groups: points by what came of them, the good first.
        labels: of the axes; a prediction of 0 parts good from bad.
        title: of the picture.
    """
    figure = new_figure(9, 5.5)
    axis = figure.subplots()
    for (name, points), colour in zip(groups.items(), ("#4c9f70", FALL_COLOUR), strict=True):
        x, y = [point[0] for point in points], [point[1] for point in points]
        axis.scatter(x, y, s=18, color=colour, alpha=0.7, label=f"{name} ({len(points)})")
    axis.axvline(0.0, color="#7f7f7f", lw=1.0, ls="--")
    axis.set(xscale="symlog", yscale="log", xlabel=labels[0], ylabel=labels[1])
    axis.grid(visible=True, lw=0.3, color="#bbbbbb")
    axis.legend(fontsize=8, framealpha=0.8)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    return figure
