"""`xrl study sweep dynamics`: does anything grow that the dynamic certificate says fades?"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeAlias

import msgspec

from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE
from tools.lab.design.dynamic_certificate import HALF_NAMES
from tools.lab.studies.sweeps import study
from tools.lab.studies.sweeps.dynamics_trial import (
    ENDINGS,
    DynamicsResult,
    DynamicsTrial,
    draw,
    run_trial,
)
from tools.lab.studies.sweeps.table import Row, code_of
from tools.live import experiment
from tools.number_arguments import count, natural
from tools.output import new_figure, save_figure
from tools.terminal import Console
from tools.verb_table import add_config

N: Final = 100
TABLE: Final = "dynamics.csv"
PICTURE: Final = "dynamics.png"
CODE: Final = code_of("tools.lab.studies.sweeps.dynamics_trial")
LABELS: Final = {
    "ended": ENDINGS,
    "mode": frozenset(("", *HALF_NAMES)),
    "said_stable": {"True", "False"},
    "grew": {"True", "False"},
}
Task: TypeAlias = "tuple[DynamicsTrial, RobotConfig]"

EXAMPLES: Final = """
    xrl study sweep dynamics
    xrl study sweep dynamics --n 400 --out out/dynamics
    xrl study sweep dynamics --only 7
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument("--n", type=count, default=N, help=f"cases ({N})")
    parser.add_argument("--only", type=natural, metavar="CASE", help="run this case alone")
    study.add_flags(parser, "dynamics", f"{TABLE} and {PICTURE}")


def run(args: argparse.Namespace) -> int:
    """Run the study; 0 if nothing grew that was said to fade."""
    executor = study.executor_of(args, CODE)
    robot = experiment.load_robot(args.config)
    console = Console()
    if args.only is not None:
        trial = draw(args.seed, args.only)
        study.show(f"Case {trial.number}", msgspec.structs.asdict(trial), console)
        outcome = run_trial(trial, robot)
        alone = _row((trial, robot), outcome)
        study.show("came out", alone, console)
        return exit_code([alone])
    trials = [draw(args.seed, number) for number in range(args.n)]
    begins = [_begin(trial) for trial in trials]
    columns = [*begins[0], *DynamicsResult.__struct_fields__, "said_stable", "grew"]
    inputs = study.inputs("dynamics", robot, CODE, seed=str(args.seed))
    command = study.command("dynamics", args, f"--seed {args.seed}")
    finished = study.run(
        study.Study(
            "dynamics", TABLE, columns, LABELS, inputs, begins, args.n, JOB,
            f"{command} --n {args.n}",
        ),
        lambda done: [(trial, robot) for trial in trials if trial.number not in done],
        args.out, executor, console,
    )  # fmt: skip
    rows = finished.rows
    draw_picture(rows, f"{len(rows)} random gains, poses and drivetrains, seed {args.seed}",
                 finished.out / PICTURE)  # fmt: skip
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
                f"{command} --only {row['number']}",
                highlight=False,
                soft_wrap=True,
            )
    finished.show_files(f"{TABLE}, {PICTURE}", "case", console)
    return exit_code(rows)


def exit_code(rows: Iterable[Mapping[str, object]]) -> int:
    """Return the exit code of cases: motion that grew against the certificate may also fall."""
    ended = {row["ended"] for row in rows if _grew(row)}
    if "fell" in ended:
        return FELL_EXIT_CODE
    return FAULT_EXIT_CODE if ended else 0


def draw_picture(rows: Sequence[Row], title: str, path: Path) -> None:
    """Draw predictions against results into a PNG file; rows as in the table."""
    figure = new_figure(9, 5.5)
    axis = figure.subplots()
    for grew, colour in (("False", "#4c9f70"), ("True", "#c0392b")):
        some = [row for row in rows if row["grew"] == grew and row["ended"] != "unready"]
        rates = [float(row["rate"]) for row in some]
        ratio = [float(row["late_rad_s"]) / max(float(row["early_rad_s"]), 1e-4) for row in some]
        label = f"{'grew' if grew == 'True' else 'faded'} ({len(some)})"
        axis.scatter(rates, ratio, s=18, color=colour, alpha=0.7, label=label)
    axis.axvline(0.0, color="#7f7f7f", lw=1.0, ls="--")
    axis.set(xscale="symlog", yscale="log")
    axis.set_xlabel("rate of the slowest motion by the certificate, 1/s: below 0 it fades")
    axis.set_ylabel("joints' rates 2 s after a tap, over those at once after it")
    axis.grid(visible=True, lw=0.3, color="#bbbbbb")
    axis.legend(fontsize=8, framealpha=0.8)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    save_figure(figure, path)


def _begin(trial: DynamicsTrial) -> dict[str, object]:
    """Return a trial's draws by column."""
    row = msgspec.structs.asdict(trial)
    factors = row.pop("damping")
    return row | {f"damping_{joint}": factor for joint, factor in enumerate(factors)}


def _row(task: Task, outcome: DynamicsResult) -> dict[str, object]:
    stability = {"said_stable": outcome.said_stable, "grew": outcome.grew}
    return _begin(task[0]) | msgspec.structs.asdict(outcome) | stability


def _run_task(task: Task) -> DynamicsResult:
    return run_trial(*task)


def _name(task: Task) -> str:
    return f"case {task[0].number} (xrl study sweep dynamics --only {task[0].number})"


def _rows(task: Task, outcome: DynamicsResult) -> list[dict[str, object]]:
    return [_row(task, outcome)]


def _grew(row: Mapping[str, object]) -> bool:
    return str(row["said_stable"]) == str(row["grew"]) == "True"


JOB: Final = study.Job(_run_task, _name, _rows, _grew)
