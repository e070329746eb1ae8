"""`xrl study certificate`: compares the sign of K_fail with falls in simulation."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np

from services.simulator.physics.plant import IDEAL
from shared.config import files as config_file
from shared.exceptions import FELL_EXIT_CODE
from tools.flags import Count
from tools.lab.studies.sweeps import certificate_trial, study
from tools.lab.studies.sweeps.certificate_trial import (
    FRICTIONLESS,
    CertificateCase,
    CertificateCases,
    CertificateResult,
)
from tools.lab.studies.sweeps.report import draw_predictions
from tools.lab.studies.sweeps.study import Study, StudyFlags, StudyRun
from tools.output import Picture

LABELS: Final = (
    "the certificate's margin, in shares of what is required",
    "COM, farthest from the posture in mm",
)


EXAMPLES: Final = """
xrl study certificate
xrl study certificate --n 1000 --seed 3 --rigid
xrl study certificate --friction
"""


class CertificateStudyFlags(StudyFlags):
    """How many, on which floor."""

    n: Count = 200
    """cases"""
    rigid: bool = False
    """a floor as hard as the certificate assumes"""
    friction: bool = False
    """with the joints' dry friction, which holds up a robot that is a little too soft"""


def report(finished: StudyRun) -> None:
    """Print what came of the study."""
    rows, console = finished.rows, finished.console
    predicted = [(row["margin"], row["stood"]) for row in rows]
    counts = Counter((margin > 0.0, stood) for margin, stood in predicted)
    console.print(
        f"said to stand: {counts[True, True]} stood, {counts[True, False]} fell\n"
        f"said to fall: {counts[False, True]} stood, {counts[False, False]} fell\n"
        f"fewest mistakes with the limit at margin {threshold(predicted):.3f}"
    )
    for row, (margin, stood) in zip(rows, predicted, strict=True):
        if (margin > 0.0) != stood:
            console.print(
                f"  case {row['number']}: margin {margin:.6g}, weakest {row['weakest']}, COM "
                f"{row['com_mm']:.6g} mm away",
                style="dim",
            )


def draw(finished: StudyRun) -> Picture:
    """Draw how far each case came over its margin."""
    rows = finished.rows
    points = {
        name: [(row["margin"], row["com_mm"]) for row in rows if row["stood"] == stood]
        for name, stood in (("stood", True), ("fell", False))
    }
    title = f"{len(rows)} random postures and gains, seed {finished.flags.seed}"
    return draw_predictions(points, LABELS, title)


def threshold(said: Sequence[tuple[float, bool]]) -> float:
    """Return the margin that parts falls from stands with the fewest mistakes.

    In the middle of the gap between two cases; not a number with fewer than two.
    """
    if len(said) < 2:
        return math.nan
    ordered = sorted(said)
    stood = np.array([was for _, was in ordered])
    # of a cut above each case: stands up to it, falls beyond it
    mistakes = np.cumsum(stood) + np.sum(~stood) - np.cumsum(~stood)
    cut = int(mistakes[:-1].argmin())
    return 0.5 * (ordered[cut][0] + ordered[cut + 1][0])


STUDY: Final = Study[CertificateCase](
    name="certificate",
    table="certificate.csv",
    pictures={"certificate.png": draw},
    load=lambda flags: config_file.load(flags.config),
    cases=lambda flags, robot: partial(CertificateCases(robot).draw, flags.seed),
    decided_by=("seed", "rigid", "friction"),
    row=certificate_trial.row_of,
    words=lambda case: f"margin {case.weakest.margin:.3g}",
    figures=CertificateResult,
    trial=certificate_trial.run_case,
    options=lambda flags: {
        "rigid": flags.rigid,
        "plant": IDEAL if flags.friction else FRICTIONLESS,
    },
    fell=lambda row: not row["stood"],
    report=report,
    exit_code=lambda row: FELL_EXIT_CODE if row["margin"] > 0.0 and not row["stood"] else 0,
)


def run(flags: CertificateStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
