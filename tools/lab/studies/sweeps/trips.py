"""`xrl study trips`: does each trip come where it is to, and none where not?"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Annotated, Final

from rich.table import Table as Printed
from rich.text import Text

from shared.bus.messages import Cause
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, RunError
from tools.flags import Arg
from tools.lab.studies.sweeps import study
from tools.lab.studies.sweeps.study import Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.lab.studies.sweeps.trips_trial import (
    PLANTS,
    TROUBLES,
    TripResult,
    TripTrial,
    run_trial,
)
from tools.live import experiment
from tools.terminal import Console, marked

EXAMPLES: Final = """
xrl study trips
xrl study trips --trouble sags --trouble drops
xrl study trips --on "k 2000" --out out/trips
"""


class TripsStudyFlags(StudyFlags):
    """Which troubles, on which plants."""

    trouble: Annotated[tuple[str, ...], Arg(choices=tuple(TROUBLES))] = ()
    """only this; may be repeated"""
    on: Annotated[tuple[str, ...], Arg(choices=tuple(PLANTS))] = ()
    """only this; may be repeated"""


def load(flags: TripsStudyFlags) -> RobotConfig:
    """Return the robot, if it has trips."""
    robot = experiment.load_robot(flags.config)
    if robot.gain_schedule is None:
        raise RunError(
            f'law.split = "{robot.law.split}": only robots of the certified split have trips'
        )
    return robot


def trials_of(flags: TripsStudyFlags) -> list[TripTrial]:
    """Return the selected troubles on the selected plants."""
    grid = product(flags.trouble or TROUBLES, flags.on or PLANTS)
    return [TripTrial(number=n, trouble=trouble, on=on) for n, (trouble, on) in enumerate(grid)]


def fell(row: Row) -> bool:
    """Return True if a trip did not save the robot."""
    return row["fell_at_s"] is not None


def exit_code(row: Row) -> int:
    """Return the exit code of a row."""
    if fell(row):
        return FELL_EXIT_CODE
    return FAULT_EXIT_CODE if wrong_with(row) else 0


def wrong_with(row: Row) -> str:
    """Return the fault of a row as text; empty: none.

    Any trip is right: different trips may detect a robot that tips over.
    """
    wanted = TROUBLES[row["trouble"]].trip
    if fell(row):
        return f"fell at {row['fell_at_s']:g} s"
    if not (row["led"] or TROUBLES[row["trouble"]].unfiltered):
        return "the robot was never led so far that anything could happen"
    if wanted is None:
        return f"tripped for nothing: {row['tripped']}" if row["tripped"] else ""
    stands = isinstance(wanted, Cause) and row["untripped_fell_at_s"] is None
    return "" if row["tripped"] or stands else f"{wanted.name} never tripped"


def _report(finished: StudyRun) -> None:
    rows, console = finished.rows, finished.console
    _show(rows, console)
    wrong = [row for row in rows if wrong_with(row)]
    for row in wrong:
        words = f"{row['trouble']} on {row['on']}: {wrong_with(row)}"
        console.print(words, style="red", highlight=False)
    if not wrong:
        console.print("what was to trip did, and stood; nothing tripped for nothing", style="green")


def _show(rows: Sequence[Row], console: Console) -> None:
    """Print troubles by plant: what tripped and how soon, and what comes of it without."""
    plants = dict.fromkeys(row["on"] for row in rows)
    troubles = dict.fromkeys(row["trouble"] for row in rows)
    printed = Printed(
        title="What tripped, after so many s; the torso's largest speed, m/s; below: untripped",
        title_justify="left",
        show_lines=True,
    )
    for heading in ("", *plants):
        printed.add_column(heading)
    for trouble in troubles:
        some = {row["on"]: _cell(row) for row in rows if row["trouble"] == trouble}
        printed.add_row(trouble, *(some[plant] for plant in plants))
    console.print(printed)
    for trouble in troubles:
        console.print(f"  {trouble:16} {TROUBLES[trouble].about}", highlight=False)


def _cell(row: Row) -> Text:
    after, fell = row["tripped_after_s"], row["untripped_fell_at_s"] is not None
    tripped = "-" if after is None else f"{row['tripped'].split()[0].lower()} {after:.2f}"
    without = "fell" if fell else f"{row['untripped_speed_max']:.2f}"
    cell = marked("{}, {:.2f}\n[dim]{}[/]", tripped, row["speed_max"], without)
    return cell if row["fell_at_s"] is None else marked("[red]fell[/] {}", cell)


STUDY: Final = Study[TripTrial](
    name="trips",
    table="trips.csv",
    load=load,
    total=lambda flags: len(trials_of(flags)),
    cases=lambda flags, _robot: trials_of(flags).__getitem__,
    decided_by=("seed",),
    inputs=lambda flags: {"grid": ", ".join(trial.words for trial in trials_of(flags))},
    words=lambda trial: trial.words,
    figures=TripResult,
    trial=run_trial,
    options=lambda flags: {"seed": flags.seed},
    fell=fell,
    report=_report,
    exit_code=exit_code,
)


def run(flags: TripsStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
