"""Tells an answer beside the predicted one: a table and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from rich import box
from rich.table import Table

from tools.bringup.tune.excitation import HOLD_S, REST_S
from tools.bringup.tune.pose_probe import ProbeCourse
from tools.bringup.tune.response import ResponseFit
from tools.output import new_figure, save_figure

_COLOURS: Final = {"measured": "#1f5fa8", "predicted": "#9aa0a6", "proposed": "#2c7a4b"}


class Probed(NamedTuple):
    """A robot that was probed, or its simulation."""

    course: ProbeCourse
    fit: ResponseFit


def answer_table(probed: Mapping[str, Probed], *, closed: bool) -> Table:
    """Return answers beside each other; a direction that the planner closes has a phase margin."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("")
    for name in probed:
        table.add_column(name, justify="right")
    table.add_column("unit")
    rows: list[tuple[str, Callable[[ResponseFit], float], str, int]] = [
        ("rise, 10 to 90 %", lambda a: a.step.rise_s, "s", 2),
        ("overshoot", lambda a: 100.0 * a.step.overshoot, "%", 0),
        ("settled within 5 %", lambda a: a.step.settling_s, "s", 2),
        ("final value", lambda a: 100.0 * a.step.final, "% of the step", 0),
        ("natural frequency", lambda a: _fitted(a, a.model.natural_frequency), "rad/s", 1),
        ("damping ratio", lambda a: _fitted(a, a.model.damping_ratio), "", 2),
    ]
    if closed:
        rows.append(("phase margin", lambda a: _fitted(a, a.phase_margin_deg), "degrees", 0))
    for what, value_of, unit, digits in rows:
        table.add_row(what, *(_number(value_of(one.fit), digits) for one in probed.values()), unit)
    return table


def draw(title: str, probed: Mapping[str, Probed], path: Path) -> None:
    """Draw step and frequency responses into a PNG file."""
    figure = new_figure(12, 6)
    figure.suptitle(title)
    axes = figure.subplot_mosaic([["step", "size"], ["step", "phase"]])
    step, size, phase = axes["step"], axes["size"], axes["phase"]
    for name, (course, answer) in probed.items():
        shown = course.t_s < REST_S + 2.0 * HOLD_S
        if not step.lines:
            step.plot(course.t_s[shown], course.r[shown], color="black", lw=0.8, label="reference")
        step.plot(course.t_s[shown], course.y[shown], color=_COLOURS[name], label=name)
        hertz = np.array([point.frequency_hz for point in answer.points])
        H = np.array([point.H for point in answer.points])
        size.plot(hertz, np.abs(H), "o", color=_COLOURS[name])
        phase.plot(hertz, np.degrees(np.unwrap(np.angle(H))), "o", color=_COLOURS[name])
        if answer.is_second_order:
            fine = np.geomspace(hertz[0], hertz[-1], 100)
            model = np.array([answer.model.at(2.0 * math.pi * one) for one in fine])
            size.plot(fine, np.abs(model), color=_COLOURS[name], lw=0.8)
            phase.plot(fine, np.degrees(np.unwrap(np.angle(model))), color=_COLOURS[name], lw=0.8)
    step.set_xlabel("s")
    step.set_ylabel("offset, m or rad")
    step.legend()
    size.set_ylabel("answer / reference")
    size.set_xscale("log")
    size.set_yscale("log")
    phase.set_xscale("log")
    phase.set_ylabel("phase, degrees")
    phase.set_xlabel("Hz (points measured, lines second order)")
    save_figure(figure, path)


def _fitted(answer: ResponseFit, value: float) -> float:
    return value if answer.is_second_order else math.nan


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
