"""The picture of the kill study: where the pushes went, and in which postures it stood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shared.config.robot_config import RobotConfig
from shared.extras import late
from tools.lab.studies.sweeps.cases import PUSHES_MAX, payloads
from tools.lab.studies.sweeps.figures import Ending
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

FALL_COLOUR: Final = "#c0392b"


def draw(rows: Sequence[Row], robot: RobotConfig, title: str, path: Path) -> None:
    """Draw the study into a PNG file."""
    figure = new_figure(13, 11)
    norm = _norm(payloads(robot))
    polar = figure.add_subplot(2, 2, 1, projection="polar")
    _draw_pushes(polar, rows, norm)
    _draw_postures(figure.add_subplot(2, 2, 2), rows, norm)
    _draw_excursions(figure.add_subplot(2, 2, 3), rows, norm, robot)
    _draw_operator(figure.add_subplot(2, 2, 4), rows, norm)
    bar = figure.colorbar(
        cm.ScalarMappable(norm, _colours()), ax=figure.axes, shrink=0.5, ticks=payloads(robot)
    )
    bar.set_label("payload in kg")
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    save_figure(figure, path)


def _colours() -> colors.Colormap:
    """Return the colours of the payload."""
    return mpl.colormaps["viridis"]


def _norm(levels: Sequence[float]) -> colors.BoundaryNorm:
    """Return a step of colour for each payload."""
    if len(set(levels)) < len(levels):
        return colors.BoundaryNorm([-0.5, 0.5], _colours().N)
    half = (levels[1] - levels[0]) / 2
    return colors.BoundaryNorm(
        [level - half for level in levels] + [levels[-1] + half], _colours().N
    )


def _scatter(
    axis: Any, points: Sequence[tuple[float, float, Row]], norm: colors.BoundaryNorm
) -> None:
    """Draw stands as dots coloured by payload (hollow: the hand was off), falls as crosses."""
    for hand_on in (True, False):
        stood = [
            p
            for p in points
            if p[2]["ending"] == Ending.STOOD and (not p[2]["let_go_s"]) == hand_on
        ]
        colours = _colours()(norm([float(row["payload_kg"]) for _, _, row in stood]))
        axis.scatter(
            [x for x, _, _ in stood],
            [y for _, y, _ in stood],
            s=22,
            facecolors=colours if hand_on else "none",
            edgecolors=colours,
            linewidths=1.0,
        )
    fell = [p for p in points if p[2]["ending"] != Ending.STOOD]
    axis.scatter(
        [x for x, _, _ in fell], [y for _, y, _ in fell],
        marker="x", s=70, color=FALL_COLOUR, linewidths=2.0, zorder=5,
    )  # fmt: skip
    for x, y, row in fell:
        axis.annotate(
            row["number"], (x, y), textcoords="offset points", xytext=(5, 5), fontsize=8,
            color=FALL_COLOUR,
        )  # fmt: skip


def _draw_pushes(axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm) -> None:
    """COM excursion over the direction of the strongest push."""
    known = [row for row in rows if row["com_max_mm"]]
    stood = [float(row["com_max_mm"]) for row in known if row["ending"] == Ending.STOOD]
    edge = 1.15 * max(stood, default=100.0)
    points = [
        (_strongest_push(row), min(float(row["com_max_mm"]), edge), row) for row in known
    ]  # a fall goes on the edge
    _scatter(axis, points, norm)
    axis.set_rlim(0.0, 1.05 * edge)
    axis.set_theta_zero_location("N")  # forward is up, left is left
    axis.set_xticks(
        [0.0, math.pi / 2, math.pi, 3 * math.pi / 2], ["forward", "left", "back", "right"]
    )
    axis.set_title(
        "COM, largest distance after the kill in mm,\nby direction of the strongest push"
    )
    handles = [
        lines.Line2D([], [], ls="", marker="o", color="#555555", label="stood, hand on"),
        lines.Line2D(
            [], [], ls="", marker="o", color="#555555", fillstyle="none", label="stood, hand off"
        ),
        lines.Line2D(
            [],
            [],
            ls="",
            marker="x",
            color=FALL_COLOUR,
            label="fell (on the edge), with its number",
        ),
    ]
    axis.legend(handles=handles, loc="lower left", bbox_to_anchor=(-0.3, -0.12), fontsize=8)


def _strongest_push(row: Row) -> float:
    """Return the direction of the strongest push, rad from x to y."""
    forces = [
        (float(row[f"push{i}_x_n"]), float(row[f"push{i}_y_n"]))
        for i in range(1, PUSHES_MAX + 1)
        if row[f"push{i}_x_n"]
    ]
    x, y = max(forces, key=lambda force: math.hypot(*force))
    return math.atan2(y, x)


def _draw_postures(axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm) -> None:
    points = [
        (float(row["kill_height_m"]), float(row["kill_pitch_rad"]), row)
        for row in rows
        if row["kill_height_m"]
    ]
    _scatter(axis, points, norm)
    axis.set_xlabel("torso height at the kill in m")
    axis.set_ylabel("torso pitch at the kill in rad")
    axis.set_title("Postures")
    axis.grid(visible=True, lw=0.3)


def _draw_excursions(
    axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm, robot: RobotConfig
) -> None:
    """Where the COM went furthest, over the soles."""
    points = []
    for row in rows:
        if row["com_max_mm"]:
            x = max((float(row["com_x_min_mm"]), float(row["com_x_max_mm"])), key=abs)
            y = max((float(row["com_y_min_mm"]), float(row["com_y_max_mm"])), key=abs)
            points.append((y, x, row))
    _scatter(axis, points, norm)
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
    stood = [abs(y) for y, _, row in points if row["ending"] == Ending.STOOD]
    limit_y = min(1.15 * max(stood, default=60.0), 1.1 * outer)
    axis.set_xlim(limit_y, -limit_y)
    axis.set_ylim(-length * 0.6, length * 0.6)
    axis.set_xlabel("COM y in mm, left is left")
    axis.set_ylabel("COM x in mm")
    axis.set_title("COM, largest way along x and y after the kill")
    axis.grid(visible=True, lw=0.3)


def _draw_operator(axis: Any, rows: Sequence[Row], norm: colors.BoundaryNorm) -> None:
    points = [
        (float(row["delay_ms"]), float(row["operator_peak_before_n"]), row)
        for row in rows
        if row["operator_peak_before_n"]
    ]
    _scatter(axis, points, norm)
    axis.set_xlabel("delay each way in ms")
    axis.set_ylabel("operator's peak force in N")
    axis.set_title("Leading, before the kill")
    axis.set_ylim(bottom=0.0)
    axis.grid(visible=True, lw=0.3)
