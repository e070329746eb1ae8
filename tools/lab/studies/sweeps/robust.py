"""`xrl study sweep robust`: every error of the plant drawn at once: who falls, and why."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias

import msgspec
import numpy as np
from rich.table import Table as Printed
from scipy.stats import spearmanr

from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.lab.studies.sweeps import plants, push_range, study
from tools.lab.studies.sweeps.figures import ENDINGS, Ending, exit_code
from tools.lab.studies.sweeps.push_range import PushRange
from tools.lab.studies.sweeps.record import run_alone
from tools.lab.studies.sweeps.robust_trial import (
    RobustResult,
    RobustTrial,
    draw,
    plant_of,
    row_of,
    run_trial,
    scenario_of,
)
from tools.lab.studies.sweeps.table import Row, code_of
from tools.lab.studies.sweeps.wilson import wilson
from tools.live import experiment
from tools.number_arguments import count, finite, natural
from tools.output import new_figure, save_figure
from tools.terminal import Console, marked
from tools.verb_table import add_config

N: Final = 100
SLOPE_MAX_DEG: Final = 15.0
TABLE: Final = "trials.csv"
PICTURE: Final = "trials.png"
CODE: Final = code_of("tools.lab.studies.sweeps.robust_trial")
FALLS_SHOWN: Final = 10
RANKED_LEAST: Final = 30
"""Trials from which errors are ranked: among fewer a correlation of 0.36 is chance."""
MARGIN: Final = "com_led_max_mm"
"""Columns of the ranking: the COM's excursion while the planner leads and the robot is pushed."""
FIGURES: Final = (
    ("operator_peak_n", "operator's force, led", "N"),
    ("com_led_max_mm", "COM, led", "mm"),
    ("com_held_max_mm", "COM, after the kill", "mm"),
    ("sole_tilt_max_rad", "tilt of a sole", "rad"),
    ("hold_step_nm", "torque step into or out of HOLD", "N m"),
)
Task: TypeAlias = "tuple[RobustTrial, RobotConfig]"

EXAMPLES: Final = """
    xrl study sweep robust
    xrl study sweep robust --n 500 --out out/robust
    xrl study sweep robust --beyond 2
    xrl study sweep robust --slope 5 --imu
    xrl study sweep robust --only 17 --out out/trial17
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument("--n", type=count, default=N, help=f"trials ({N})")
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
    parser.add_argument(
        "--only",
        type=natural,
        metavar="TRIAL",
        help="run this trial alone and print all of it; exit code 1 if it fell",
    )
    alone = "; with --only: where the trial's log goes (default: none)"
    study.add_flags(parser, "robust", f"{TABLE} and {PICTURE}", alone)


def run(args: argparse.Namespace) -> int:
    """Run the study, or one trial of it; 0 if none fell."""
    if not 0.0 <= args.slope <= SLOPE_MAX_DEG:
        raise RunError(f"--slope {args.slope:g}: 0 to {SLOPE_MAX_DEG:g} degrees")
    push_range.check(args)
    executor = study.executor_of(args, CODE)
    robot = experiment.load_robot(args.config, imu=args.imu)
    plants.draw("check", beyond=args.beyond)
    console = Console()
    if args.only is not None:
        return _run_one(args, robot, console)
    pushes = PushRange(robot, args.push)
    drawn = [draw(pushes, args.seed, number, args.beyond, args.slope) for number in range(args.n)]
    rows_begin = [row_of(trial) for trial in drawn]
    columns = [*rows_begin[0], *RobustResult.__struct_fields__]
    inputs = study.inputs(
        "robust", robot, CODE, seed=str(args.seed), beyond=f"{args.beyond:g}",
        slope=f"{args.slope:g}", push=f"{args.push:g}", ranges=plants.digest(),
    )  # fmt: skip
    finished = study.run(
        study.Study(
            "robust", TABLE, columns, LABELS, inputs, rows_begin, args.n, JOB,
            f"{_command(args)} --n {args.n}",
        ),
        lambda done: [(trial, robot) for trial in drawn if trial.number not in done],
        args.out, executor, console,
    )  # fmt: skip
    rows = finished.rows
    _draw(rows, args, finished.out / PICTURE)
    _show(rows, _command(args), console)
    finished.show_files(f"{TABLE}, {PICTURE}", "trial", console)
    return exit_code(row["ending"] for row in rows)


def _run_one(args: argparse.Namespace, robot: RobotConfig, console: Console) -> int:
    trial = draw(PushRange(robot, args.push), args.seed, args.only, args.beyond, args.slope)
    study.show(f"Trial {trial.number}, drawn", row_of(trial), console)
    return run_alone(
        partial(run_trial, trial, robot),
        scenario_of(robot, trial),
        robot,
        args.out,
        {"lockstep": f"{_command(args)} --only {trial.number}; delay {trial.delay_ms:g} ms"},
        console,
        plant_of(trial),
    )


def ranking(rows: Sequence[Row]) -> list[tuple[str, float]]:
    """Return each error with its rank correlation with the COM's excursion, strongest first.

    Of errors that go both ways the size counts; a trial that fell counts as the farthest.
    """
    far = np.array([_excursion(row) for row in rows])
    found = []
    for error in plants.shipped().error:
        values = np.array([float(row[error.key]) for row in rows])
        size = np.abs(values - 0.5 * (error.low + error.high)) if error.low < 0.0 else values
        if np.ptp(size) > 0.0 and np.ptp(far) > 0.0:
            found.append((error.key, float(spearmanr(size, far).statistic)))
    return sorted(found, key=lambda pair: -abs(pair[1]))


def _excursion(row: Row) -> float:
    value = row[MARGIN]
    fell = row["ending"] != Ending.STOOD
    return 1e3 if fell or value is None or value == "" else float(value)


def _draw(rows: Sequence[Row], args: argparse.Namespace, path: Path) -> None:
    """Draw what takes the margin, and the excursions by stiffness, into a PNG file."""
    figure = new_figure(13, 6.5)
    left, right = figure.subplots(1, 2)
    ranked = ranking(rows)[:14][::-1]
    left.barh([key for key, _ in ranked], [value for _, value in ranked], color="#1f5f8b")
    left.axvline(0.0, color="black", linewidth=0.8)
    left.set_xlabel("rank correlation with the COM's excursion while led")
    few = f" ({len(rows)} trials: too few to tell)" if len(rows) < RANKED_LEAST else ""
    left.set_title(f"Which error takes most of the margin{few}")
    for ending, marker, colour in ((True, "o", "#1f5f8b"), (False, "x", "#c0392b")):
        some = [row for row in rows if (row["ending"] == Ending.STOOD) == ending]
        right.scatter(
            [float(row["drivetrain.stiffness"]) for row in some],
            [min(200.0, _excursion(row)) for row in some],
            marker=marker, color=colour, s=18, label="stood" if ending else "fell",
        )  # fmt: skip
    right.set_xscale("log")
    right.set_xlabel("drivetrain stiffness, N m/rad")
    right.set_ylabel("COM from the middle of the ankles while led, mm (fell: 200)")
    right.legend()
    fell = sum(row["ending"] != Ending.STOOD for row in rows)
    figure.suptitle(
        f"{len(rows)} trials, every error drawn, ranges x{args.beyond:g}, seed {args.seed}, "
        f"{push_range.describe(args)}: {fell} fell",
        x=0.01,
        ha="left",
    )
    save_figure(figure, path)


def _show(rows: Sequence[Row], command: str, console: Console) -> None:
    """Print what came of the study."""
    fallen = [row for row in rows if row["ending"] != Ending.STOOD]
    for row in fallen[:FALLS_SHOWN]:
        console.print(
            marked(
                "[red]{}[/] {} {}: {} --only {}",
                row["ending"],
                row["kind"],
                row["number"],
                command,
                row["number"],
            ),
            highlight=False,
            soft_wrap=True,
        )
    standing = [row for row in rows if row["ending"] == Ending.STOOD]
    if standing:
        printed = Printed(title="Standing trials", title_justify="left")
        for heading in ("what", "median", "largest", ""):
            printed.add_column(heading)
        for key, words, unit in FIGURES:
            values = [float(row[key]) for row in standing if row[key] not in (None, "")]
            if values:
                printed.add_row(words, f"{np.median(values):.3g}", f"{max(values):.3g}", unit)
        console.print(printed)
    if len(rows) < RANKED_LEAST:
        most = f"{len(rows)} trials are too few to tell; from {RANKED_LEAST} on they are ranked"
    else:
        most = ", ".join(f"{key} {value:+.2f}" for key, value in ranking(rows)[:5])
    console.print(f"takes most of the margin (rank correlation): {most}", soft_wrap=True)
    colour = "red" if fallen else "green"
    low, high = wilson(len(fallen), len(rows))
    console.print(
        marked(
            f"[bold {colour}]{{}} falls of {{}}[/]; share of falls {{:.2f}} to {{:.2f}} % "
            "(95 %, Wilson)",
            len(fallen),
            len(rows),
            100 * low,
            100 * high,
        ),
        highlight=False,
    )


def _run_task(task: Task) -> RobustResult:
    return run_trial(*task)


def _name(task: Task) -> str:
    return f"trial {task[0].number} (xrl study sweep robust --only {task[0].number})"


def _rows(task: Task, outcome: RobustResult) -> list[dict[str, object]]:
    return [row_of(task[0]) | msgspec.structs.asdict(outcome)]


LABELS: Final = {"ending": ENDINGS, "kind": frozenset(("squat", "crawl", "lean"))}
JOB: Final = study.Job(_run_task, _name, _rows, lambda row: row["ending"] != Ending.STOOD)


def _command(args: argparse.Namespace) -> str:
    """Return the command of this study, but for --n, --only and --out."""
    flags = [f"--seed {args.seed}", *push_range.flags(args)]
    if args.beyond != 1.0:
        flags.append(f"--beyond {args.beyond:g}")
    if args.slope != 0.0:
        flags.append(f"--slope {args.slope:g}")
    if args.imu:
        flags.append("--imu")
    return study.command("robust", args, *flags)
