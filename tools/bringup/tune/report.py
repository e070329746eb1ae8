"""Tells an answer beside the predicted one: a table and a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np
from rich import box
from rich.table import Table

from tools.bringup.tune.excitation import HOLD_S, REST_S
from tools.bringup.tune.pose_probe import ProbeCourse
from tools.bringup.tune.response import ResponseFit
from tools.output import new_figure, save_figure

_COLOURS: Final = {"measured": "#1f5fa8", "predicted": "#9aa0a6", "proposed": "#2c7a4b"}


def answer_table(answers: dict[str, ResponseFit], *, closed: bool) -> Table:
    """Return answers beside each other.

    Args:
        answers: by what they are of.
        closed: the planner closes this direction, so that it has a phase margin.
    """
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("")
    for name in answers:
        table.add_column(name, justify="right")
    table.add_column("unit")
    step = {name: one.step for name, one in answers.items()}
    rows = (
        ("rise, 10 to 90 %", [s.rise_s for s in step.values()], "s", 2),
        ("overshoot", [100.0 * s.overshoot for s in step.values()], "%", 0),
        ("settled within 5 %", [s.settling_s for s in step.values()], "s", 2),
        ("final value", [100.0 * s.final for s in step.values()], "% of the step", 0),
        ("natural frequency", [_fitted(a, a.model.natural_frequency) for a in answers.values()],
         "rad/s", 1),
        ("damping ratio", [_fitted(a, a.model.damping_ratio) for a in answers.values()], "", 2),
    )  # fmt: skip
    for what, values, unit, digits in rows:
        table.add_row(what, *(_number(value, digits) for value in values), unit)
    if closed:
        margins = [_fitted(a, a.phase_margin_deg) for a in answers.values()]
        table.add_row("phase margin", *(_number(value, 0) for value in margins), "degrees")
    return table


def draw(
    title: str, courses: dict[str, ProbeCourse], answers: dict[str, ResponseFit], path: Path
) -> None:
    """Draw step and frequency responses into a PNG file."""
    figure = new_figure(12, 6)
    figure.suptitle(title)
    axes = figure.subplot_mosaic([["step", "size"], ["step", "phase"]])
    step, size, phase = axes["step"], axes["size"], axes["phase"]
    asked = False
    for name, course in courses.items():
        shown = course.t_s < REST_S + 2.0 * HOLD_S
        if not asked:
            step.plot(course.t_s[shown], course.r[shown], color="black", lw=0.8, label="reference")
            asked = True
        step.plot(course.t_s[shown], course.y[shown], color=_COLOURS[name], label=name)
    for name, answer in answers.items():
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
