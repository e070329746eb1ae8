"""`xrl study dynamics`: does anything grow that the dynamic certificate says fades?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Final

from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE
from tools.flags import Count
from tools.lab.studies.sweeps import dynamics_trial, study
from tools.lab.studies.sweeps.dynamics_trial import DynamicsResult, DynamicsTrial
from tools.lab.studies.sweeps.report import draw_predictions
from tools.lab.studies.sweeps.study import AloneFlags, Finished, Study
from tools.lab.studies.sweeps.table import Row

PICTURE: Final = "dynamics.png"
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


def report(finished: Finished) -> None:
    """Draw and print what came of the study."""
    rows, console = finished.rows, finished.console
    tried = [row for row in rows if row["ended"] != "unready"]
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
    points = {
        name: [
            (row["rate"], row["late_rad_s"] / max(row["early_rad_s"], 1e-4))
            for row in tried
            if row["grew"] == grew
        ]
        for name, grew in (("faded", False), ("grew", True))
    }
    title = f"{len(rows)} random gains, poses and drivetrains, seed {finished.flags.seed}"
    draw_predictions(points, LABELS, title, finished.out / PICTURE)


def grew_against_it(row: Row) -> bool:
    """Return True for motion that grew although the certificate said it fades."""
    return bool(row["said_stable"] and row["grew"])


def exit_code(rows: Sequence[Row]) -> int:
    """Return the exit code of cases: motion that grew against the certificate may also fall."""
    ended = {row["ended"] for row in rows if grew_against_it(row)}
    if "fell" in ended:
        return FELL_EXIT_CODE
    return FAULT_EXIT_CODE if ended else 0


STUDY: Final = Study[DynamicsTrial](
    name="dynamics",
    table="dynamics.csv",
    pictures=(PICTURE,),
    code=("tools.lab.studies.sweeps.dynamics_trial",),
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
