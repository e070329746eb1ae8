"""`xrl study sweep trips`: does each trip come where it is to, and none where not?"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Final, TypeAlias

import msgspec
from rich.table import Table as Printed
from rich.text import Text

from shared.bus.messages import Cause, Trip
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, RunError
from tools.lab.studies.sweeps import study
from tools.lab.studies.sweeps.table import Row, code_of
from tools.lab.studies.sweeps.trips_trial import PLANTS, TROUBLES, TripResult, run_trial
from tools.live import experiment
from tools.terminal import Console, marked
from tools.verb_table import add_config

TABLE: Final = "trips.csv"
CODE: Final = code_of("tools.lab.studies.sweeps.trips_trial")
Task: TypeAlias = "tuple[int, str, str, RobotConfig, int]"
"""Number, trouble, plant, robot, seed of the noise."""

EXAMPLES: Final = """
    xrl study sweep trips
    xrl study sweep trips --trouble sags --trouble drops
    xrl study sweep trips --on "k 2000" --out out/trips
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    for flag, names in (("trouble", TROUBLES), ("on", PLANTS)):
        parser.add_argument(
            f"--{flag}", action="append", choices=tuple(names), help="only this; may be repeated"
        )
    study.add_flags(parser, "trips", TABLE)


def run(args: argparse.Namespace) -> int:
    """Run the study; 0 if each trip came where it is to, and saved the robot.

    Raises:
        RunError: on this robot nothing trips.
    """
    executor = study.executor_of(args, CODE)
    robot = experiment.load_robot(args.config)
    if robot.gain_schedule is None:
        raise RunError(
            f'law.split = "{robot.law.split}": only robots of the certified split have trips'
        )
    console = Console()
    grid = list(product(args.trouble or TROUBLES, args.on or PLANTS))
    begins = [
        {"number": number, "trouble": trouble, "on": plant}
        for number, (trouble, plant) in enumerate(grid)
    ]
    columns = [*begins[0], *TripResult.__struct_fields__]
    inputs = study.inputs("trips", robot, CODE, grid=repr(grid), seed=str(args.seed))
    finished = study.run(
        study.Study(
            "trips", TABLE, columns, LABELS, inputs, begins, len(grid), JOB, _command(args)
        ),
        lambda done: [
            (number, trouble, plant, robot, args.seed)
            for number, (trouble, plant) in enumerate(grid)
            if number not in done
        ],
        args.out, executor, console,
    )  # fmt: skip
    rows = finished.rows
    _show(rows, console)
    wrong = [row for row in rows if wrong_with(row)]
    for row in wrong:
        console.print(
            f"{row['trouble']} on {row['on']}: {wrong_with(row)}", style="red", highlight=False
        )
    if not wrong:
        console.print("what was to trip did, and stood; nothing tripped for nothing", style="green")
    finished.show_files(TABLE, "case", console)
    return exit_code(rows)


def exit_code(rows: Sequence[Row]) -> int:
    """Return the exit code of a table: a trip that did not save the robot before all else."""
    if any(row["fell_at_s"] for row in rows):
        return FELL_EXIT_CODE
    return FAULT_EXIT_CODE if any(map(wrong_with, rows)) else 0


def wrong_with(row: Mapping[str, str]) -> str:
    """Return the fault of a row as text; empty: none.

    Any trip is right: different trips may detect a robot that tips over.
    """
    wanted = TROUBLES[row["trouble"]].trip
    if row["fell_at_s"]:
        return f"fell at {row['fell_at_s']} s"
    if row["led"] != "True" and not TROUBLES[row["trouble"]].unfiltered:
        return "the robot was never led so far that anything could happen"
    if wanted is None:
        return f"tripped for nothing: {row['tripped']}" if row["tripped"] else ""
    if row["tripped"]:
        return ""
    stands = isinstance(wanted, Cause) and not row["untripped_fell_at_s"]
    return "" if stands else f"{wanted.name} never tripped"


def _show(rows: Sequence[Row], console: Console) -> None:
    """Print troubles by plant: what tripped and how soon, and what comes of it without."""
    plants = list(dict.fromkeys(row["on"] for row in rows))
    printed = Printed(
        title="What tripped, after so many s; the torso's largest speed, m/s; below: untripped",
        title_justify="left",
        show_lines=True,
    )
    for heading in ("", *plants):
        printed.add_column(heading)
    for trouble in dict.fromkeys(row["trouble"] for row in rows):
        some = {row["on"]: _cell(row) for row in rows if row["trouble"] == trouble}
        printed.add_row(trouble, *(some[plant] for plant in plants))
    console.print(printed)
    for trouble in dict.fromkeys(row["trouble"] for row in rows):
        console.print(f"  {trouble:16} {TROUBLES[trouble].about}", highlight=False)


def _cell(row: Row) -> Text:
    after = row["tripped_after_s"]
    with_trips = f"{row['tripped'].split()[0].lower()} {float(after):.2f}" if after else "-"
    with_trips += f", {float(row['speed_max']):.2f}"
    fell = bool(row["untripped_fell_at_s"])
    without = "fell" if fell else f"{float(row['untripped_speed_max']):.2f}"
    cell = marked("{}\n[dim]{}[/]", with_trips, without)
    return marked("[red]fell[/] {}", cell) if row["fell_at_s"] else cell


def _run_task(task: Task) -> TripResult:
    _, trouble, plant, robot, seed = task
    return run_trial(trouble, plant, robot, seed)


def _name(task: Task) -> str:
    return f"{task[1]} on {task[2]}"


def _rows(task: Task, outcome: TripResult) -> list[dict[str, object]]:
    number, trouble, plant, *_ = task
    begin = {"number": number, "trouble": trouble, "on": plant}
    return [begin | msgspec.structs.asdict(outcome)]


class _TripNames(frozenset[str]):
    """Words of the column of trips: names of trips and causes, in any number."""

    def __contains__(self, text: object) -> bool:
        known = {trip.name for trip in Trip} | {cause.name for cause in Cause}
        return isinstance(text, str) and set(text.split()) <= known


LABELS: Final = {
    "trouble": frozenset(TROUBLES),
    "on": frozenset(PLANTS),
    "led": frozenset(("True", "False")),
    "tripped": _TripNames(),
}
JOB: Final = study.Job(_run_task, _name, _rows, lambda row: bool(row["fell_at_s"]))


def _command(args: argparse.Namespace) -> str:
    """Return the command of this study, but for `--out`."""
    flags = [
        f"--{flag} {value!r}" for flag in ("trouble", "on") for value in getattr(args, flag) or ()
    ]
    return study.command("trips", args, f"--seed {args.seed}", *flags)
