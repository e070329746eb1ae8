"""`xrl study push`: the hardest push by direction, duration, pose and mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Annotated, Any, Final

import msgspec
from rich.table import Table as Printed

from services.simulator.physics import plant as plants
from services.simulator.physics.plant import plant_from
from tools.flags import Arg, Degrees, Duration
from tools.lab.studies.sweeps import push_trial, study
from tools.lab.studies.sweeps.push_trial import MODES, POSES, PushResult, PushTrial
from tools.lab.studies.sweeps.report import FALL_COLOUR
from tools.lab.studies.sweeps.study import Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.live.experiment import PlantFlags
from tools.output import Picture, new_figure

ANGLES_DEG: Final = (0, 45, 90, 135, 180)
"""Left and right are alike."""
SIDES_DEG: Final = ("0", "45", "90", "135", "180", "-135", "-90", "-45")
"""Degrees of a push to the right."""
DURATIONS_S: Final = (0.3, 3.0)
SHORT: Final = {"led": "leads", "dead": "dead"}
CURVES: Final = (
    ("led", "stood_n", "#1f5f8b", "-o", "planner leads"),
    ("dead", "stood_n", FALL_COLOUR, "-o", "planner dead"),
    ("dead", "held_limit_n", FALL_COLOUR, "--", "gains of HOLD, push lasting"),
    ("dead", "body_limit_n", "black", "--", "soles and motors, push lasting"),
)
"""Mode, column, colour, line, in words."""


EXAMPLES: Final = """
xrl study push
xrl study push --pose stand --duration 3 --angle 90
xrl study push --plant drivetrain.stiffness=2000 --out out/soft
"""


class PushStudyFlags(StudyFlags, PlantFlags):
    """Which points."""

    pose: Annotated[tuple[str, ...], Arg(choices=tuple(POSES))] = ()
    """only this one; may be repeated"""
    angle: Annotated[tuple[Degrees, ...], Arg(metavar="DEG")] = ()
    """push that way, 0 forwards, 90 to the left; may be repeated (0, 45, 90, 135, 180)"""
    duration: tuple[Duration, ...] = ()
    """of the pushes; may be repeated (0.3, 3)"""


def trials_of(flags: PushStudyFlags) -> list[PushTrial]:
    """Return the selected points."""
    durations = tuple(flags.duration or DURATIONS_S)
    grid = product(flags.pose or POSES, durations, flags.angle or ANGLES_DEG, MODES)
    return [
        PushTrial(number=number, pose=pose, angle_deg=angle, duration_s=duration, mode=mode)
        for number, (pose, duration, angle, mode) in enumerate(grid)
    ]


def _inputs(flags: PushStudyFlags) -> dict[str, str]:
    grid = repr([msgspec.structs.astuple(trial) for trial in trials_of(flags)])
    return {"plant": plants.to_toml(plant_from(flags.plant)), "grid": grid}


def report(finished: StudyRun) -> None:
    """Print the hardest pushes by direction, and what gives way in the weakest."""
    rows = finished.rows
    angles = [f"{angle} deg" for angle in dict.fromkeys(row["angle_deg"] for row in rows)]
    printed = Printed(title="Hardest push that it stood, N", title_justify="left")
    for heading in ("pose", "s", "planner", *angles, "gives way"):
        printed.add_column(heading, no_wrap=True)
    groups: dict[tuple[str, float, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["pose"], row["duration_s"], row["mode"]), []).append(row)
    for (pose, duration, mode), some in groups.items():
        forces = [f"{row['stood_n']:g}" for row in some]
        weakest = min(some, key=lambda row: float(row["stood_n"]))
        printed.add_row(pose, f"{duration:g}", SHORT[mode], *forces, weakest["held_part"])
    finished.console.print(printed)


def draw(finished: StudyRun) -> Picture:
    """Draw the envelopes: a panel for each pose and duration, forwards is up."""
    rows = finished.rows
    poses = list(dict.fromkeys(row["pose"] for row in rows))
    durations = list(dict.fromkeys(row["duration_s"] for row in rows))
    figure = new_figure(0.5 + 4.6 * len(poses), 0.8 + 4.6 * len(durations), dpi=100)
    for number, (duration, pose) in enumerate(product(durations, poses)):
        axis: Any = figure.add_subplot(len(durations), len(poses), number + 1, projection="polar")
        axis.set_theta_zero_location("N")
        for mode, column, colour, line, words in CURVES:
            points = sorted(
                (row["angle_deg"], row[column])
                for row in rows
                if (row["pose"], row["duration_s"], row["mode"]) == (pose, duration, mode)
            )
            _draw_curve(axis, points, line, color=colour, label=words, markersize=4)
        axis.set_thetagrids(range(0, 360, 45), SIDES_DEG)
        axis.set_title(f"{pose}, {duration:g} s, N")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.suptitle("Hardest push that it stood, by direction (up: forwards)", x=0.01, ha="left")
    return figure


def _draw_curve(axis: Any, points: Sequence[tuple[int, float]], line: str, **style: object) -> None:
    """Draw a curve and its mirror image."""
    mirrored = [(-angle, force) for angle, force in reversed(points) if 0 < angle < 180]
    closing = points[:1] if len(points) > 2 else []
    around = [*points, *mirrored, *closing]
    angles = [math.radians(angle) for angle, _ in around]
    axis.plot(angles, [force for _, force in around], line, **style)


STUDY: Final = Study[PushTrial](
    name="push",
    case="point",
    table="pushes.csv",
    pictures={"pushes.png": draw},
    total=lambda flags: len(trials_of(flags)),
    cases=lambda flags, _robot: trials_of(flags).__getitem__,
    inputs=_inputs,
    words=lambda at: f"{at.pose}, {at.angle_deg} degrees, {at.duration_s:g} s, {at.mode}",
    figures=PushResult,
    trial=push_trial.run_trial,
    options=lambda flags: {"plant": plant_from(flags.plant)},
    fell=lambda _row: False,
    report=report,
    exit_code=lambda _row: 0,
)


def run(flags: PushStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
