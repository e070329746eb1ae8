"""`xrl study robust`: every error of the plant drawn at once: who falls, and why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np

from shared.config.robot_config import RobotConfig
from shared.extras import late
from shared.toml_file import Range
from tools.flags import Arg, Count, Number
from tools.lab.studies.sweeps import plants, push_range, robust_trial, study
from tools.lab.studies.sweeps.figures import Ending
from tools.lab.studies.sweeps.push_range import PushFlags, PushRange
from tools.lab.studies.sweeps.report import (
    FALL_COLOUR,
    parted,
    show_falls,
    show_figures,
    show_share,
)
from tools.lab.studies.sweeps.robust_trial import RobustResult, RobustTrial
from tools.lab.studies.sweeps.study import AloneFlags, CaseLog, Study, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.live.experiment import ImuFlags
from tools.output import Picture, new_figure

if TYPE_CHECKING:
    from scipy import stats
else:
    stats = late("scipy.stats")

SLOPE_MAX_DEG: Final = 15.0
RANKED_LEAST: Final = 30
"""Trials from which errors are ranked: among fewer a correlation of 0.36 is chance."""
FIGURES: Final = (
    ("operator_peak_n", "operator's force, led", "N"),
    ("com_led_max_mm", "COM, led", "mm"),
    ("com_held_max_mm", "COM, after the kill", "mm"),
    ("sole_tilt_max_rad", "tilt of a sole", "rad"),
    ("hold_step_nm", "torque step into or out of HOLD", "N m"),
)


EXAMPLES: Final = """
xrl study robust
xrl study robust --n 500 --out out/robust
xrl study robust --beyond 2
xrl study robust --slope 5 --imu
xrl study robust --only 17 --out out/trial17
"""


class RobustStudyFlags(AloneFlags, ImuFlags, PushFlags):
    """How many, and how far from the file."""

    n: Count = 100
    """trials"""
    beyond: Annotated[Number, Arg(metavar="F")] = 1.0
    """widen every range of deploy/plants/ranges.toml F times about its middle"""
    slope: Annotated[float, Range(0.0, SLOPE_MAX_DEG, "degrees"), Arg(metavar="DEG")] = 0.0
    """a floor that slopes by DEG degrees in a drawn direction (default: up to 1 degree, as in the
    ranges)"""

    def check(self) -> None:
        """Refuse ranges that cannot be drawn from."""
        super().check()
        plants.draw("check", beyond=self.beyond)


def _cases(flags: RobustStudyFlags, robot: RobotConfig) -> Callable[[int], RobustTrial]:
    pushes = PushRange(robot, flags.push)
    return lambda number: robust_trial.draw(pushes, flags.seed, number, flags.beyond, flags.slope)


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


def report(finished: StudyRun) -> None:
    """Print what came of the study."""
    rows, console = finished.rows, finished.console
    standing, fallen = parted(rows)
    show_falls(
        fallen, finished.command, lambda row: f"{row['kind']}: trial {row['number']}", console
    )
    if standing:
        show_figures(standing, FIGURES, {"median": median, "largest": max}, console)
    if len(rows) < RANKED_LEAST:
        most = f"{len(rows)} trials are too few to tell; from {RANKED_LEAST} on they are ranked"
    else:
        most = ", ".join(f"{key} {value:+.2f}" for key, value in ranking(rows)[:5])
    console.print(f"takes most of the margin (rank correlation): {most}", soft_wrap=True)
    show_share(len(fallen), len(rows), console)


def draw(finished: StudyRun) -> Picture:
    """Draw what takes the margin, and the excursions by stiffness."""
    flags, rows = finished.flags, finished.rows
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
    title = f"{len(rows)} trials, every error drawn, ranges x{flags.beyond:g}, seed {flags.seed}, "
    title += f"{push_range.describe(flags)}: {len(parted(rows)[1])} fell"
    figure.suptitle(title, x=0.01, ha="left")
    return figure


STUDY: Final = Study[RobustTrial](
    name="robust",
    case="trial",
    table="trials.csv",
    pictures={"trials.png": draw},
    load=lambda flags: experiment.load_robot(flags.config, imu=flags.imu),
    cases=_cases,
    decided_by=("seed", "beyond", "slope", "push"),
    inputs=lambda _flags: {"ranges": plants.digest()},
    row=robust_trial.row_of,
    figures=RobustResult,
    trial=robust_trial.run_trial,
    log=CaseLog(
        robust_trial.scenario_of,
        robust_trial.plant_of,
        lambda trial, command: {"lockstep": f"{command}; delay {trial.delay_ms:g} ms"},
    ),
    report=report,
)


def run(flags: RobustStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
