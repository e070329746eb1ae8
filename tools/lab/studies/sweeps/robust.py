"""`xrl study sweep robust`: every error of the plant drawn at once: who falls, and why."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from rich.table import Table as Printed

from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.extras import late
from tools.lab.studies.sweeps import plants, push_range, robust_trial
from tools.lab.studies.sweeps.figures import Ending
from tools.lab.studies.sweeps.push_range import PushRange
from tools.lab.studies.sweeps.report import FALL_COLOUR, parted, show_falls, show_share
from tools.lab.studies.sweeps.robust_trial import RobustResult, RobustTrial
from tools.lab.studies.sweeps.study import CaseLog, Finished, Study
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.number_arguments import finite
from tools.output import new_figure, save_figure

if TYPE_CHECKING:
    from scipy import stats
else:
    stats = late("scipy.stats")

SLOPE_MAX_DEG: Final = 15.0
PICTURE: Final = "trials.png"
RANKED_LEAST: Final = 30
"""Trials from which errors are ranked: among fewer a correlation of 0.36 is chance."""
FIGURES: Final = (
    ("operator_peak_n", "operator's force, led", "N"),
    ("com_led_max_mm", "COM, led", "mm"),
    ("com_held_max_mm", "COM, after the kill", "mm"),
    ("sole_tilt_max_rad", "tilt of a sole", "rad"),
    ("hold_step_nm", "torque step into or out of HOLD", "N m"),
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's own flags."""
    parser.add_argument(
        "--beyond",
        type=finite,
        default=1.0,
        metavar="F",
        help="widen every range of deploy/plants/ranges.toml F times about its middle (1)",
    )
    parser.add_argument(
        "--slope",
        type=finite,
        default=0.0,
        metavar="DEG",
        help="a floor that slopes by DEG degrees in a drawn direction (default: up to 1 degree, as "
        "in the ranges)",
    )
    push_range.add_flag(parser)
    experiment.add_imu(parser)


def load(args: argparse.Namespace) -> RobotConfig:
    """Check the flags and return the robot."""
    if not 0.0 <= args.slope <= SLOPE_MAX_DEG:
        raise RunError(f"--slope {args.slope:g}: 0 to {SLOPE_MAX_DEG:g} degrees")
    push_range.check(args)
    plants.draw("check", beyond=args.beyond)
    return experiment.load_robot(args.config, imu=args.imu)


def _cases(args: argparse.Namespace, robot: RobotConfig) -> Callable[[int], RobustTrial]:
    pushes = PushRange(robot, args.push)
    return lambda number: robust_trial.draw(pushes, args.seed, number, args.beyond, args.slope)


def ranking(rows: Sequence[Row]) -> list[tuple[str, float]]:
    """Return each error with its rank correlation with the COM's excursion, strongest first.

    Of errors that go both ways the size counts; a trial that fell counts as the farthest.
    """
    far = np.array([_excursion(row) for row in rows])
    found = []
    for error in plants.shipped().error:
        values = np.array([row[error.key] for row in rows])
        size = np.abs(values - 0.5 * (error.low + error.high)) if error.low < 0.0 else values
        if np.ptp(size) > 0.0 and np.ptp(far) > 0.0:
            found.append((error.key, float(stats.spearmanr(size, far).statistic)))
    return sorted(found, key=lambda pair: -abs(pair[1]))


def _excursion(row: Row) -> float:
    """Return the COM's excursion while the planner leads and the robot is pushed, mm."""
    value: float | None = row["com_led_max_mm"]
    return 1e3 if row["ending"] is not Ending.STOOD or value is None else value


def report(finished: Finished) -> None:
    """Draw and print what came of the study."""
    args, rows, console = finished.args, finished.rows, finished.console
    standing, fallen = parted(rows)
    title = f"{len(rows)} trials, every error drawn, ranges x{args.beyond:g}, seed {args.seed}, "
    title += f"{push_range.describe(args)}: {len(fallen)} fell"
    draw(rows, title, finished.out / PICTURE)
    show_falls(
        fallen, finished.command, lambda row: f"{row['kind']}: trial {row['number']}", console
    )
    if standing:
        printed = Printed("what", "median", "largest", "")
        printed.title, printed.title_justify = "Standing trials", "left"
        for key, words, unit in FIGURES:
            values = [row[key] for row in standing if row[key] is not None]
            if values:
                printed.add_row(words, f"{np.median(values):.3g}", f"{max(values):.3g}", unit)
        console.print(printed)
    if len(rows) < RANKED_LEAST:
        most = f"{len(rows)} trials are too few to tell; from {RANKED_LEAST} on they are ranked"
    else:
        most = ", ".join(f"{key} {value:+.2f}" for key, value in ranking(rows)[:5])
    console.print(f"takes most of the margin (rank correlation): {most}", soft_wrap=True)
    show_share(len(fallen), len(rows), console)


def draw(rows: Sequence[Row], title: str, path: Path) -> None:
    """Draw what takes the margin, and the excursions by stiffness, into a PNG file."""
    figure = new_figure(13, 6.5)
    left, right = figure.subplots(1, 2)
    ranked = ranking(rows)[:14][::-1]
    left.barh([key for key, _ in ranked], [value for _, value in ranked], color="#1f5f8b")
    left.axvline(0.0, color="black", linewidth=0.8)
    left.set_xlabel("rank correlation with the COM's excursion while led")
    few = f" ({len(rows)} trials: too few to tell)" if len(rows) < RANKED_LEAST else ""
    left.set_title(f"Which error takes most of the margin{few}")
    styles = ("stood", "o", "#1f5f8b"), ("fell", "x", FALL_COLOUR)
    for some, (label, marker, colour) in zip(parted(rows), styles, strict=True):
        x = [row["drivetrain.stiffness"] for row in some]
        y = [min(200.0, _excursion(row)) for row in some]
        right.scatter(x, y, marker=marker, color=colour, s=18, label=label)
    right.set_xscale("log")
    right.set_xlabel("drivetrain stiffness, N m/rad")
    right.set_ylabel("COM from the middle of the ankles while led, mm (fell: 200)")
    right.legend()
    figure.suptitle(title, x=0.01, ha="left")
    save_figure(figure, path)


def _metadata(trial: RobustTrial, command: str) -> dict[str, str]:
    return {"lockstep": f"{command}; delay {trial.delay_ms:g} ms"}


STUDY: Final = Study[RobustTrial](
    name="robust",
    case="trial",
    table="trials.csv",
    pictures=(PICTURE,),
    code=("tools.lab.studies.sweeps.robust_trial",),
    n=100,
    only="run this trial alone and print all of it; exit code 1 if it fell",
    add_flags=add_flags,
    load=load,
    cases=_cases,
    decided_by=("seed", "beyond", "slope", "push"),
    inputs=lambda _args: {"ranges": plants.digest()},
    row=robust_trial.row_of,
    figures=RobustResult,
    trial=robust_trial.run_trial,
    log=CaseLog(robust_trial.scenario_of, robust_trial.plant_of, _metadata),
    report=report,
)
