"""Tells what was identified: a table, pictures, the robot file's new lines, what has to follow."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from shared.config.robot_config import RobotConfig
from tools.bringup.identify.body_fit import BodyFit
from tools.bringup.identify.estimates import (
    JointResult,
    ParameterEstimate,
    Value,
    Verdict,
    changes,
    measured,
    remarks,
)
from tools.bringup.identify.quasi_static import SLOT_S
from tools.bringup.identify.robot_file_edit import apply, refuse_other_robot
from tools.output import new_figure, save_figure
from tools.terminal import Console

FARTHEST: Final = 6.0
"""Half widths; an interval farther away is an arrow."""
SCHEDULED: Final = ("joint.armature", "mass.", "geometry.")
"""Beginnings of keys that the gain schedule depends on."""
_STYLES: Final = {
    Verdict.CHANGE: ("bold yellow", "#c0392b"), Verdict.AGREES: ("green", "#2c7a4b"),
    Verdict.MEASURED: ("", "#1f5fa8"), Verdict.UNKNOWN: ("dim", "#9aa0a6"),
}  # fmt: skip
"""On a terminal, and in a picture."""


def estimates_table(estimates: Sequence[ParameterEstimate]) -> Table:
    """Return the estimates as a table for the terminal."""
    table = Table(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)  # in 80 columns
    table.add_column("")
    for heading in ("robot file", "measured", "95 %"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("", no_wrap=True)
    for row in estimates:
        digits, (style, _) = row.digits, _STYLES[row.verdict]
        table.add_row(
            row.what, "" if row.file is None else f"{row.file:.{digits}f}",
            f"{row.value:.{digits}f}", f"± {row.half_width:.{digits}f}", row.unit,
            Text(row.verdict.value, style),
        )  # fmt: skip
    return table


def lines_of(values: Mapping[str, Value]) -> str:
    """Return the robot file's new lines, by section."""
    text, section_before = "", ""
    for key in sorted(values):
        section, name = key.split(".")
        if section != section_before:
            text += f"[{section}]\n"
        section_before = section
        value = values[key]
        text += f"{name} = {list(value) if isinstance(value, tuple) else value}\n"
    return text


def tell(
    estimates: list[ParameterEstimate], robot: RobotConfig, path: Path | None, console: Console
) -> None:
    """Print the estimates, what to write and what to know; write it into the robot file `path`."""
    values, known = changes(estimates, robot), measured(estimates)
    console.print(estimates_table(estimates))
    if values:
        console.print("to write into the robot file (`--apply` does, after a backup):")
        console.print(lines_of(values), markup=False, highlight=False, end="")
    else:
        console.print("nothing to write: the robot file agrees with the measurement")
    if known:
        console.print(f"measured now, no longer assumed: {', '.join(sorted(known))}", style="dim")
    for remark in remarks(estimates, robot):
        console.print(remark, style="yellow")
    if path is None:
        return
    refuse_other_robot(path, robot, values)
    if not values and not known:
        console.print(f"{path}: nothing to write")
        return
    backup = apply(path, values, known, time.strftime("%Y%m%d-%H%M%S"))
    console.print(f"{path}: written; the old file: {backup}")
    if any(key.startswith(SCHEDULED) for key in values):
        console.print(
            f"now `xrl gains --config {shlex.quote(str(path))}`: the gain schedule no longer fits"
        )


def draw_body(estimates: Sequence[ParameterEstimate], fit: BodyFit, path: Path) -> None:
    """Draw intervals, and both sets of equations before and after, into a PNG file."""
    figure = new_figure(13, 8)
    right = _draw_intervals(figure, estimates, width=1.1)
    axes = right.subplots(3, 1, sharex=True)
    t = SLOT_S * np.arange(len(fit.residuals))
    rows = (
        ("residual force, N", fit.residuals_before[:, 2], fit.residuals[:, 2], "up"),
        ("residual moment, N m", fit.residuals_before[:, 4], fit.residuals[:, 4], "about pitch"),
        ("feet apart, mm", 1e3 * fit.feet_before[:, 3], 1e3 * fit.feet[:, 3], "along x"),
    )
    for axis, (label, before, after, what) in zip(axes, rows, strict=True):
        axis.plot(t, before, ".", ms=3, color="#9aa0a6", label=f"{what}, by the robot file")
        axis.plot(t, after, ".", ms=3, color="#1f5fa8", label=f"{what}, as identified")
        axis.axhline(0.0, lw=0.8, color="black")
        axis.set_ylabel(label)
        axis.legend(loc="upper right", fontsize=8)
    axes[-1].set_xlabel("quasi-static time, s")
    save_figure(figure, path)


def draw_joints(
    estimates: Sequence[ParameterEstimate], results: Sequence[JointResult], path: Path
) -> None:
    """Draw intervals, and each joint's torque over its angle beside the fit, into a PNG file."""
    figure = new_figure(13, 2.0 + 2.4 * len(results))
    right = _draw_intervals(figure, estimates, width=1.0)
    axes = right.subplots(len(results), 1, squeeze=False)[:, 0]
    for axis, (joint, fit, _) in zip(axes, results, strict=True):
        axis.plot(1e3 * fit.q, fit.tau, ".", ms=1.5, color="#9aa0a6", label="measured")
        axis.plot(1e3 * fit.q, fit.fitted, ".", ms=1.5, color="#1f5fa8", label="fitted")
        axis.set_ylabel(f"{joint}\ntorque, N m")
        axis.legend(loc="upper right", fontsize=8, markerscale=4)
    axes[-1].set_xlabel("angle from its mean, mrad")
    save_figure(figure, path)


def _draw_intervals(figure: Any, estimates: Sequence[ParameterEstimate], *, width: float) -> Any:
    """Draw each interval, in its own half widths, about the file's value; return the right half."""
    left, right = figure.subfigures(1, 2, width_ratios=(width, 1.0))
    axis = left.subplots(1, 1)
    for place, row in enumerate(reversed(estimates)):
        file = row.value if row.file is None else row.file
        by = (row.value - file) / row.half_width if row.half_width else 0.0
        _, colour = _STYLES[row.verdict]
        if abs(by) > FARTHEST:
            axis.plot(math.copysign(FARTHEST, by), place, ">" if by > 0.0 else "<", color=colour)
            continue
        axis.errorbar(by, place, xerr=1.0, fmt="o", ms=5, color=colour, capsize=3)
    labels = [
        f"{row.what}: {row.value:.4g} ± {row.half_width:.2g} {row.unit}"
        + ("" if row.file is None else f" (file {row.file:.4g})")
        for row in reversed(estimates)
    ]
    axis.set_yticks(range(len(estimates)), labels, fontsize=8)
    axis.axvline(0.0, lw=0.8, color="black")
    axis.set_xlabel("difference from the robot file, in half widths of the 95 % interval")
    axis.set_title("red: change   green: agrees   grey: not shown by this record", fontsize=9)
    axis.set_xlim(-FARTHEST - 0.5, FARTHEST + 0.5)
    return right
