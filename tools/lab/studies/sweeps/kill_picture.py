"""The picture of the kill study: where the pushes went, and in which postures it stood."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared.config.robot_config import RobotConfig
from shared.extras import late
from tools.lab.studies.sweeps.figures import Ending
from tools.lab.studies.sweeps.kill_trial import PUSHES_MAX, payloads
from tools.lab.studies.sweeps.report import FALL_COLOUR, parted
from tools.lab.studies.sweeps.table import Row
from tools.output import new_figure, save_figure

if TYPE_CHECKING:
    import matplotlib as mpl
    from matplotlib import cm, colors, lines, patches

else:
    mpl = late("matplotlib")
    cm = late("matplotlib.cm")
    colors = late("matplotlib.colors")
    lines = late("matplotlib.lines")
    patches = late("matplotlib.patches")


def draw(rows: Sequence[Row], robot: RobotConfig, title: str, path: Path) -> None:
    """Draw the study into a PNG file."""
    figure = new_figure(13, 11)
    norm = _norm(payloads(robot))
    _draw_pushes(figure.add_subplot(2, 2, 1, projection="polar"), rows, norm)
    postures = figure.add_subplot(2, 2, 2)
    points = _points(rows, "kill_height_m", "kill_pitch_rad")
    _draw(postures, points, norm, "Postures")
    postures.set(xlabel="torso height at the kill in m", ylabel="torso pitch at the kill in rad")
    _draw_excursions(figure.add_subplot(2, 2, 3), rows, norm, robot)
    operator = figure.add_subplot(2, 2, 4)
    points = _points(rows, "delay_ms", "operator_peak_before_n")
    _draw(operator, points, norm, "Leading, before the kill")
    operator.set(xlabel="delay each way in ms", ylabel="operator's peak force in N")
    operator.set_ylim(bottom=0.0)
    bar = figure.colorbar(
        cm.ScalarMappable(norm, _colours()), ax=figure.axes, shrink=0.5, ticks=payloads(robot)
    )
    bar.set_label("payload in kg")
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    save_figure(figure, path)


Point = tuple[float, float, Row]


def _points(rows: Iterable[Row], x: str, y: str) -> list[Point]:
    """Return two columns of the cases that have both."""
    return [(row[x], row[y], row) for row in rows if None not in (row[x], row[y])]


def _colours() -> colors.Colormap:
    """Return the colours of the payload."""
    return mpl.colormaps["viridis"]


def _norm(levels: Sequence[float]) -> colors.BoundaryNorm:
    """Return a step of colour for each payload."""
    if len(set(levels)) < len(levels):
        return colors.BoundaryNorm([-0.5, 0.5], _colours().N)
    half = (levels[1] - levels[0]) / 2
    edges = [level - half for level in levels]
    return colors.BoundaryNorm([*edges, levels[-1] + half], _colours().N)


def _draw(axis: Any, points: Sequence[Point], norm: colors.BoundaryNorm, title: str) -> None:
    """Draw stands as dots coloured by payload (hollow: the hand was off), falls as crosses."""
    standing = [point for point in points if point[2]["ending"] is Ending.STOOD]
    for hand_on in (True, False):
        some = [point for point in standing if (point[2]["let_go_s"] is None) == hand_on]
        edges = _colours()(norm([row["payload_kg"] for _, _, row in some]))
        axis.scatter(
            [x for x, _, _ in some], [y for _, y, _ in some],
            s=22, facecolors=edges if hand_on else "none", edgecolors=edges, linewidths=1.0,
        )  # fmt: skip
    for x, y, row in points:
        if row["ending"] is not Ending.STOOD:
            axis.scatter(x, y, marker="x", s=70, color=FALL_COLOUR, linewidths=2.0, zorder=5)
            axis.annotate(
                row["number"], (x, y), textcoords="offset points", xytext=(5, 5), fontsize=8,
                color=FALL_COLOUR,
            )  # fmt: skip
    axis.set_title(title)
    axis.grid(visible=True, lw=0.3)


def _draw_pushes(axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm) -> None:
    """COM excursion over the direction of the strongest push."""
    known = [row for row in rows if row["com_max_mm"] is not None]
    edge = 1.15 * max((row["com_max_mm"] for row in parted(known)[0]), default=100.0)
    points = [
        (_strongest_push(row), min(row["com_max_mm"], edge), row) for row in known
    ]  # a fall goes on the edge
    title = "COM, largest distance after the kill in mm,\nby direction of the strongest push"
    _draw(axis, points, norm, title)
    axis.set_rlim(0.0, 1.05 * edge)
    axis.set_theta_zero_location("N")  # forward is up, left is left
    axis.set_xticks(
        [0.0, math.pi / 2, math.pi, 3 * math.pi / 2], ["forward", "left", "back", "right"]
    )
    styles: Sequence[Any] = (
        ("stood, hand on", "o", "full", "#555555"),
        ("stood, hand off", "o", "none", "#555555"),
        ("fell (on the edge), with its number", "x", "full", FALL_COLOUR),
    )
    handles = [
        lines.Line2D([], [], ls="", marker=marker, fillstyle=fill, color=colour, label=words)
        for words, marker, fill, colour in styles
    ]
    axis.legend(handles=handles, loc="lower left", bbox_to_anchor=(-0.3, -0.12), fontsize=8)


def _strongest_push(row: Row) -> float:
    """Return the direction of the strongest push, rad from x to y."""
    pushes = [(row[f"push{i}_x_n"], row[f"push{i}_y_n"]) for i in range(1, PUSHES_MAX + 1)]
    x, y = max((push for push in pushes if None not in push), key=lambda push: math.hypot(*push))
    return math.atan2(y, x)


def _draw_excursions(
    axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm, robot: RobotConfig
) -> None:
    """Where the COM went furthest, over the soles."""
    points = [
        (
            max(row["com_y_min_mm"], row["com_y_max_mm"], key=abs),
            max(row["com_x_min_mm"], row["com_x_max_mm"], key=abs),
            row,
        )
        for row in rows
        if row["com_max_mm"] is not None
    ]
    _draw(axis, points, norm, "COM, largest way along x and y after the kill")
    geometry = robot.geometry
    length, width, base = (1e3 * v for v in (geometry.l_foot, geometry.w_foot, geometry.w_base))
    outer = (base + width) / 2
    axis.add_patch(
        patches.Rectangle(
            (-outer, -length / 2), 2 * outer, length, fill=False, ls="--", color="#777777"
        )
    )
    axis.annotate(
        "edge of the support", (0.02, length / 2), xycoords=("axes fraction", "data"),
        textcoords="offset points", xytext=(0, 3), fontsize=8, color="#777777",
    )  # fmt: skip
    stood = [abs(y) for y, _, row in points if row["ending"] is Ending.STOOD]
    limit_y = min(1.15 * max(stood, default=60.0), 1.1 * outer)
    axis.set_xlim(limit_y, -limit_y)
    axis.set_ylim(-length * 0.6, length * 0.6)
    axis.set(xlabel="COM y in mm, left is left", ylabel="COM x in mm")
