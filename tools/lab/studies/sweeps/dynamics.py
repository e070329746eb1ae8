"""`xrl study dynamics`: does anything grow that the dynamic certificate says fades?"""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import Final

from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE
from tools.flags import Count
from tools.lab.studies.sweeps import dynamics_trial, study
from tools.lab.studies.sweeps.dynamics_trial import DynamicsResult, DynamicsTrial
from tools.lab.studies.sweeps.report import draw_predictions
from tools.lab.studies.sweeps.study import AloneFlags, Study, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.output import Picture

LABELS: Final = (
    "rate of the slowest motion by the certificate, 1/s: below 0 it fades",
    "joints' rates 2 s after a tap, over those at once after it",
)


EXAMPLES: Final = """
xrl study dynamics
xrl study dynamics --n 400 --out out/dynamics
xrl study dynamics --only 7
"""


class DynamicsStudyFlags(AloneFlags):
    """How many."""

    n: Count = 100
    """cases"""


def report(finished: StudyRun) -> None:
    """Print what came of the study."""
    rows, console, tried = finished.rows, finished.console, tried_in(finished)
    counts = Counter((row["said_stable"], row["grew"]) for row in tried)
    console.print(
        f"said to fade: {counts[True, False]} faded, {counts[True, True]} grew\n"
        f"said to grow: {counts[False, True]} grew, {counts[False, False]} did not; "
        f"{len(rows) - len(tried)} never stood with the shipped gains",
        highlight=False,
    )
    for row in filter(grew_against_it, rows):
        console.print(
            f"  case {row['number']}: said {row['rate']:.2f}/s at {row['frequency_hz']:.1f} Hz, "
            f"{row['mode']}: {row['ended']}, {row['early_rad_s']:.3f} to {row['late_rad_s']:.3f} "
            f"rad/s: {finished.command} --only {row['number']}",
            highlight=False,
            soft_wrap=True,
        )


def tried_in(finished: StudyRun) -> list[Row]:
    """Return the cases in which the drawn gains took over."""
    return [row for row in finished.rows if row["ended"] != "unready"]


def draw(finished: StudyRun) -> Picture:
    """Draw how the motion changed over the rate that the certificate gives it."""
    points = {
        name: [
            (row["rate"], row["late_rad_s"] / max(row["early_rad_s"], 1e-4))
            for row in tried_in(finished)
            if row["grew"] == grew
        ]
        for name, grew in (("faded", False), ("grew", True))
    }
    title = f"{len(finished.rows)} random gains, poses and drivetrains, seed {finished.flags.seed}"
    return draw_predictions(points, LABELS, title)


def grew_against_it(row: Row) -> bool:
    """Return True for motion that grew although the certificate said it fades."""
    return bool(row["said_stable"] and row["grew"])


def exit_code(row: Row) -> int:
    """Return the exit code of a case: motion that grew against the certificate may also fall."""
    if not grew_against_it(row):
        return 0
    return FELL_EXIT_CODE if row["ended"] == "fell" else FAULT_EXIT_CODE


STUDY: Final = Study[DynamicsTrial](
    name="dynamics",
    table="dynamics.csv",
    pictures={"dynamics.png": draw},
    cases=lambda flags, _robot: partial(dynamics_trial.draw, flags.seed),
    decided_by=("seed",),
    row=dynamics_trial.row_of,
    figures=DynamicsResult,
    trial=dynamics_trial.run_trial,
    fell=grew_against_it,
    report=report,
    exit_code=exit_code,
)


def run(flags: DynamicsStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
