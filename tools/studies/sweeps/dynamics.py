"""`xrl sweep dynamics`: does anything grow that the dynamic certificate says fades?"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, TypeAlias

import matplotlib as mpl
import msgspec
from matplotlib.figure import Figure
from rich.console import Console

from services.planner.dynamic_certificate import HALF_NAMES
from shared.config.robot_config import RobotConfig
from shared.process import DEFAULT_CONFIG
from tools.runs import experiment
from tools.studies.sweeps import study
from tools.studies.sweeps.dynamics_trial import (
    ENDINGS,
    DynamicsResult,
    DynamicsTrial,
    draw,
    run_trial,
)
from tools.studies.sweeps.table import CaseTable, Row, code_digest, code_of
from tools.verb_table import add_config

mpl.use("Agg")

N: Final = 100
TABLE: Final = "dynamics.csv"
PICTURE: Final = "dynamics.png"
CODE: Final = code_of("tools.studies.sweeps.dynamics_trial")
WORDS: Final = {
    "ended": ENDINGS,
    "mode": frozenset(("", *HALF_NAMES)),
    "said_stable": {"True", "False"},
    "grew": {"True", "False"},
}
Task: TypeAlias = "tuple[DynamicsTrial, RobotConfig]"

EXAMPLES: Final = """
    xrl sweep dynamics
    xrl sweep dynamics --n 400 --out out/dynamics
    xrl sweep dynamics --only 7
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument("--n", type=int, default=N, help=f"cases ({N})")
    parser.add_argument("--only", type=int, metavar="CASE", help="run this case alone")
    study.add_flags(parser, "dynamics", f"{TABLE} and {PICTURE}")


def run(args: argparse.Namespace) -> int:
    """Run the study; 1 if anything grew that was said to fade."""
    study.check_least(("--n", args.n, 1), ("--only", args.only or 0, 0))
    crew = study.executor_of(args, CODE)
    robot = experiment.load_robot(args.config)
    console = Console()
    if args.only is not None:
        trial = draw(args.seed, args.only)
        study.show(f"Case {trial.number}", msgspec.structs.asdict(trial), console)
        outcome = run_trial(trial, robot)
        study.show("came out", _row((trial, robot), outcome), console)
        return 1 if outcome.said_stable and outcome.grew else 0
    out = study.folder(args.out, "dynamics")
    trials = [draw(args.seed, number) for number in range(args.n)]
    begins = [_begin(trial) for trial in trials]
    columns = [*begins[0], *DynamicsResult.__struct_fields__, "said_stable", "grew"]
    with CaseTable(out, TABLE, columns, _inputs(args, robot), WORDS, begins) as table:
        missing = [(trial, robot) for trial in trials if trial.number not in table.numbers]
        with study.resumable(table, out, f"{_command(args)} --n {args.n}", crew, console):
            study.fill(table, JOB, missing, crew, args.n, console)
    rows = table.rows(args.n)
    draw_picture(rows, f"{len(rows)} random gains, poses and drivetrains, seed {args.seed}",
                 out / PICTURE)  # fmt: skip
    counts = {
        (said, grew): sum(
            row["said_stable"] == str(said) and row["grew"] == str(grew) for row in rows
        )
        for said in (True, False)
        for grew in (True, False)
    }
    unready = sum(row["ended"] == "unready" for row in rows)
    console.print(
        f"said to fade: {counts[True, False]} faded, {counts[True, True]} grew\n"
        f"said to grow: {counts[False, True]} grew, {counts[False, False] - unready} did not; "
        f"{unready} never stood with the shipped gains",
        highlight=False,
    )
    for row in rows:
        if row["said_stable"] == row["grew"] == "True":
            console.print(
                f"  case {row['number']}: said {float(row['rate']):.2f}/s at "
                f"{float(row['frequency_hz']):.1f} Hz, {row['mode']}: {row['ended']}, "
                f"{float(row['early_rad_s']):.3f} to {float(row['late_rad_s']):.3f} rad/s: "
                f"{_command(args)} --only {row['number']}",
                highlight=False,
                soft_wrap=True,
            )
    console.print(f"{out / TABLE}, {PICTURE}", style="dim", soft_wrap=True)
    return 1 if counts[True, True] else 0


def draw_picture(rows: Sequence[Row], title: str, path: Path) -> None:
    """Draw what was said against what happened into a PNG file; rows as in the table."""
    figure = Figure(figsize=(9, 5.5), dpi=110, layout="constrained")
    axis = figure.subplots()
    for grew, colour in (("False", "#4c9f70"), ("True", "#c0392b")):
        some = [row for row in rows if row["grew"] == grew and row["ended"] != "unready"]
        said = [float(row["rate"]) for row in some]
        ratio = [float(row["late_rad_s"]) / max(float(row["early_rad_s"]), 1e-4) for row in some]
        label = f"{'grew' if grew == 'True' else 'faded'} ({len(some)})"
        axis.scatter(said, ratio, s=18, color=colour, alpha=0.7, label=label)
    axis.axvline(0.0, color="#7f7f7f", lw=1.0, ls="--")
    axis.set(xscale="symlog", yscale="log")
    axis.set_xlabel("rate of the slowest motion by the certificate, 1/s: below 0 it fades")
    axis.set_ylabel("joints' rates 2 s after a tap, over those at once after it")
    axis.grid(visible=True, lw=0.3, color="#bbbbbb")
    axis.legend(fontsize=8, framealpha=0.8)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    figure.savefig(path)


def _begin(trial: DynamicsTrial) -> dict[str, object]:
    """Return a trial's draws by column."""
    row = msgspec.structs.asdict(trial)
    factors = row.pop("damping")
    return row | {f"damping_{joint}": factor for joint, factor in enumerate(factors)}


def _row(task: Task, outcome: DynamicsResult) -> dict[str, object]:
    said = {"said_stable": outcome.said_stable, "grew": outcome.grew}
    return _begin(task[0]) | msgspec.structs.asdict(outcome) | said


def _run_task(task: Task) -> DynamicsResult:
    return run_trial(*task)


def _name(task: Task) -> str:
    return f"case {task[0].number} (xrl sweep dynamics --only {task[0].number})"


def _rows(task: Task, outcome: DynamicsResult) -> list[dict[str, object]]:
    return [_row(task, outcome)]


def _grew(row: Mapping[str, object]) -> bool:
    return str(row["said_stable"]) == str(row["grew"]) == "True"


JOB: Final = study.Job(_run_task, _name, _rows, _grew)


def _command(args: argparse.Namespace) -> str:
    """Return the command of this study, but for --n, --only and --out."""
    flags = [f"--seed {args.seed}"]
    if args.config != DEFAULT_CONFIG:
        flags.append(f"--config {args.config}")
    return " ".join(["xrl sweep dynamics", *flags])


def _inputs(args: argparse.Namespace, robot: RobotConfig) -> dict[str, str]:
    return {
        "study": "dynamics",
        "seed": str(args.seed),
        "robot": study.digest_of(robot),
        "code": code_digest(CODE),
    }
