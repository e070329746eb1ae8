"""The pictures of the latency study: who fell where, and what the hand had to do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

import matplotlib as mpl
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from tools.sweeps.latency_report import (
    chosen,
    controls_in,
    falls,
    figures,
    values_in,
    without_loss,
)
from tools.sweeps.latency_trial import DURATION_S, PUSH_N, PUSHES
from tools.sweeps.table import Row

mpl.use("Agg")

FALLS: Final = "latency-falls.png"
EFFORT: Final = "latency-effort.png"
SHARES: Final = LinearSegmentedColormap.from_list("falls", ["#e3f1e7", "#f2b7a0", "#b3261e"])
"""From none fell to all fell."""
HOLDS: Final = 0.1
"""With a larger share of the time in HOLD, a robot does not follow the hand."""
DPI: Final = 120


class Look(NamedTuple):
    """How a control is drawn; told apart without colour as well."""

    colour: str
    marker: str
    shift: float
    """Of a delay's place, so that nothing hides another."""


LOOKS: Final = {
    "distributed": Look("#1b7f4b", "o", -0.12),
    "diagonal": Look("#c77700", "s", 0.0),
    "centralised": Look("#7b3fa0", "^", 0.12),
}


def draw(rows: Sequence[Row], force_max: float, what: str, folder: Path) -> tuple[Path, ...]:
    """Draw both pictures into PNG files.

    Args:
        rows: of the table.
        force_max: all that the hand gives, N.
        what: what else there is to say of the study, such as its seed.
        folder: of the files.

    Returns:
        The files.
    """
    paths = folder / FALLS, folder / EFFORT
    _draw_falls(rows, what, paths[0])
    _draw_effort(without_loss(rows), force_max, what, paths[1])
    return paths


def _draw_falls(rows: Sequence[Row], what: str, path: Path) -> None:
    names = controls_in(rows)
    figure = Figure(figsize=(7.5, 6.4), dpi=DPI, layout="constrained")
    grid = figure.add_gridspec(2, len(names), height_ratios=(1.0, 1.15))
    for index, name in enumerate(names):
        axis = figure.add_subplot(grid[0, index])
        _draw_map(axis, rows, name)
        axis.set_ylabel("messages lost in %" if index == 0 else "")
        if index:
            axis.set_yticklabels([])
    _draw_shares(figure.add_subplot(grid[1, :]), rows)
    figure.suptitle(
        f"Who falls: {len(rows)} runs of {DURATION_S:g} s, led by hand, {PUSHES} pushes of "
        f"{PUSH_N[0]:g} to {PUSH_N[1]:g} N in each;\n"
        f"all links get bad, both ways, on the way down; {what}",
        fontsize=11, x=0.01, ha="left",
    )  # fmt: skip
    figure.savefig(path)


def _draw_map(axis: Any, rows: Sequence[Row], name: str) -> None:
    """Share of falls over delay and loss, with the falls and the trials in each cell."""
    delays, losses = values_in(rows, "delay_ms"), values_in(rows, "loss")
    cells = [
        [falls(chosen(rows, name, delay_ms=delay, loss=loss)) for delay in delays]
        for loss in losses
    ]
    shares = [[cell.fallen / max(1, cell.of) for cell in line] for line in cells]
    axis.imshow(shares, cmap=SHARES, vmin=0.0, vmax=1.0, origin="lower", aspect="auto")
    if len(delays) * len(losses) <= 50:
        for y, line in enumerate(cells):
            for x, cell in enumerate(line):
                light = cell.fallen > 0.7 * cell.of
                axis.text(
                    x, y, f"{cell.fallen}/{cell.of}", ha="center", va="center", fontsize=8,
                    color="white" if light else "#333333",
                )  # fmt: skip
    axis.set_xticks(range(len(delays)), [f"{delay:g}" for delay in delays], fontsize=8)
    axis.set_yticks(range(len(losses)), [f"{100 * loss:g}" for loss in losses], fontsize=9)
    axis.set_xlabel("delay each way in ms", fontsize=9)
    axis.set_title(name, fontsize=10)


def _draw_shares(axis: Any, rows: Sequence[Row]) -> None:
    """Share of falls over the delay, all losses together, with its 95 % band."""
    delays = values_in(rows, "delay_ms")
    for name in controls_in(rows):
        look = LOOKS[name]
        counted = [falls(chosen(rows, name, delay_ms=delay)) for delay in delays]
        places = [x + look.shift for x, count in enumerate(counted) if count.of]
        counted = [count for count in counted if count.of]
        shares = [100 * count.fallen / count.of for count in counted]
        low, high = zip(*(count.bounds for count in counted), strict=True)
        axis.fill_between(
            places, [100 * v for v in low], [100 * v for v in high], color=look.colour, alpha=0.13,
            lw=0,
        )  # fmt: skip
        spread = [
            [max(0.0, s - 100 * v) for s, v in zip(shares, low, strict=True)],
            [max(0.0, 100 * v - s) for s, v in zip(shares, high, strict=True)],
        ]
        axis.errorbar(
            places, shares, yerr=spread, color=look.colour, marker=look.marker, ms=6, lw=1.6,
            elinewidth=1.2, capsize=3, label=f"{name} ({_in_all(rows, name)})",
        )  # fmt: skip
    each = falls(chosen(rows, controls_in(rows)[0], delay_ms=delays[0])).of
    axis.set_xticks(range(len(delays)), [f"{delay:g}" for delay in delays])
    axis.set_ylim(-3.0, 103.0)
    axis.set_xlabel("delay each way in ms (not to scale)")
    axis.set_ylabel("falls in %")
    axis.set_title(
        f"All losses together: share of falls, and its 95 % interval (Wilson), {each} trials a "
        "point",
        fontsize=10,
    )  # fmt: skip
    axis.legend(fontsize=9, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2), frameon=False)
    axis.grid(visible=True, lw=0.3)


def _in_all(rows: Sequence[Row], name: str) -> str:
    count = falls(chosen(rows, name))
    return f"{count.fallen} of {count.of} fell"


def _draw_effort(rows: Sequence[Row], force_max: float, what: str, path: Path) -> None:
    figure = Figure(figsize=(7.5, 6.0), dpi=DPI, layout="constrained")
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
    loss = 100 * float(rows[0]["loss"])
    figure.suptitle(
        f"What the hand meets: squats under {PUSHES} pushes, {loss:g} % lost; {len(rows)} runs, "
        f"{what}",
        fontsize=11, x=0.01, ha="left",
    )  # fmt: skip
    figure.savefig(path)


def _draw_control(effort: Any, hold: Any, rows: Sequence[Row], name: str) -> None:
    look = LOOKS[name]
    line = {"color": look.colour, "lw": 1.6}
    held: list[tuple[float, float]] = []
    points: list[tuple[float, float, float, float]] = []
    for x, delay in enumerate(values_in(rows, "delay_ms")):
        own = chosen(rows, name, delay_ms=delay)
        forces, shares = figures(own, "operator_peak_n"), figures(own, "hold_share")
        if not forces:
            continue
        place, middle, share = x + look.shift, median(forces), median(shares)
        points.append((place, min(forces), middle, max(forces)))
        held.append((place, 100 * share))
        face = "white" if share > HOLDS else look.colour
        effort.plot(
            place, middle, marker=look.marker, ms=6, mfc=face, color=look.colour, zorder=4
        )  # fmt: skip
        if falls(own).fallen:
            effort.plot(place, middle, "x", color="#222222", ms=9, mew=1.8, zorder=5)
    if not points:
        return
    places, low, middles, high = zip(*points, strict=True)
    effort.fill_between(places, low, high, color=look.colour, alpha=0.15, lw=0)
    effort.plot(places, middles, label=name, marker=look.marker, ms=6, **line)
    hold.plot(*zip(*held, strict=True), marker=look.marker, ms=6, **line)
