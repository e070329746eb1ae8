"""Pictures of what was identified: intervals against the file, and what is left over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tools.bringup.identify.body_fit import BodyFit
from tools.bringup.identify.estimates import JointResult, ParameterEstimate, Verdict
from tools.bringup.identify.quasi_static import SLOT_S
from tools.output import new_figure, save_figure

FARTHEST = 6.0
"""Half widths; an interval farther away is an arrow."""
_COLOURS = {
    Verdict.CHANGE: "#c0392b", Verdict.AGREES: "#2c7a4b", Verdict.MEASURED: "#1f5fa8",
    Verdict.UNKNOWN: "#9aa0a6",
}  # fmt: skip


def draw_body(estimates: Sequence[ParameterEstimate], fit: BodyFit, path: Path) -> None:
    """Draw intervals, and both sets of equations before and after, into a PNG file.

    Args:
        estimates: of the fit.
        fit: whose residuals are drawn.
        path: of the picture.
    """
    figure = new_figure(13, 8)
    parts: Any = figure.subfigures(1, 2, width_ratios=(1.1, 1.0))
    left, right = parts
    _draw_intervals(estimates, left.subplots(1, 1))
    axes = right.subplots(3, 1, sharex=True)
    t = SLOT_S * np.arange(len(fit.residuals))
    rows = (
        ("force left over, N", fit.residuals_before[:, 2], fit.residuals[:, 2], "up"),
        ("moment left over, N m", fit.residuals_before[:, 4], fit.residuals[:, 4], "about pitch"),
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


def _draw_intervals(estimates: Sequence[ParameterEstimate], axis: Any) -> None:
    """Draw each interval, in its own half widths, about the file's value."""
    for place, row in enumerate(reversed(estimates)):
        file = row.value if row.file is None else row.file
        by = (row.value - file) / row.half_width if row.half_width else 0.0
        colour = _COLOURS[row.verdict]
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
    axis.set_xlabel("away from the robot file, in half widths of the 95 % interval")
    axis.set_title("red: change   green: agrees   grey: not shown by this record", fontsize=9)
    axis.set_xlim(-FARTHEST - 0.5, FARTHEST + 0.5)


def draw_joints(
    estimates: Sequence[ParameterEstimate], results: Sequence[JointResult], path: Path
) -> None:
    """Draw intervals, and each joint's torque over its angle beside the fit, into a PNG file."""
    figure = new_figure(13, 2.0 + 2.4 * len(results))
    parts: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.0))
    left, right = parts
    _draw_intervals(estimates, left.subplots(1, 1))
    axes = right.subplots(len(results), 1, squeeze=False)[:, 0]
    for axis, (joint, fit, _) in zip(axes, results, strict=True):
        axis.plot(1e3 * fit.q, fit.tau, ".", ms=1.5, color="#9aa0a6", label="measured")
        axis.plot(1e3 * fit.q, fit.fitted, ".", ms=1.5, color="#1f5fa8", label="fitted")
        axis.set_ylabel(f"{joint}\ntorque, N m")
        axis.legend(loc="upper right", fontsize=8, markerscale=4)
    axes[-1].set_xlabel("angle from its mean, mrad")
    save_figure(figure, path)
