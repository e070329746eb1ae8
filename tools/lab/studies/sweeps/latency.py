"""`xrl study sweep latency`: three controls over networks from good to hopeless, under pushes."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Final, TypeAlias

import msgspec

from shared.config.robot_config import RobotConfig
from shared.toml_file import check_ranges
from tools.lab.studies.sweeps import latency_picture, latency_report, plants, study
from tools.lab.studies.sweeps.figures import ENDINGS, Ending, exit_code
from tools.lab.studies.sweeps.latency_trial import (
    CONTROLS,
    FLAG_DIGITS,
    LatencyResult,
    LatencyTrial,
    Network,
    plain,
    plant_of,
    robot_of,
    run_trial,
)
from tools.lab.studies.sweeps.record import run_alone
from tools.lab.studies.sweeps.table import code_of
from tools.live import experiment
from tools.number_arguments import count, finite, natural
from tools.terminal import Console
from tools.verb_table import add_config

DELAYS_MS: Final = "0,10,20,30,50,100,200"
LOSSES: Final = "0,0.1,0.3,0.5"
TRIALS: Final = 4
DELAY_MAX_MS: Final = 60_000.0
VALUES_MAX: Final = 1000
TABLE: Final = "latency.csv"
CODE: Final = code_of("tools.lab.studies.sweeps.latency_trial")
"""What decides how a trial comes out."""
COLUMNS_OUT: Final = LatencyResult.__struct_fields__
LABELS: Final = {"control": frozenset(CONTROLS), "ending": ENDINGS}
Task: TypeAlias = "tuple[LatencyTrial, RobotConfig]"

EXAMPLES: Final = """
    xrl study sweep latency
    xrl study sweep latency --delay 0:200:10 --jitter 5 --loss 0,0.2 --trials 10 --out out/latency
    xrl study sweep latency --control distributed --delay 0:60:5 --loss 0 --lead-easing 0
    xrl study sweep latency --only 137 --out out/trial137
    xrl study sweep latency --cluster tcp://HOST:8786
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    delays = values_in(0.0, DELAY_MAX_MS)
    parser.add_argument(
        "--delay",
        type=delays,
        default=delays(DELAYS_MS),
        metavar="MS",
        help=f"of every link, each way: numbers and A:B:STEP, with commas ({DELAYS_MS})",
    )
    parser.add_argument(
        "--jitter",
        type=delays,
        default=(0.0,),
        metavar="MS",
        help="half the width of a uniform spread; several as for --delay (0)",
    )
    shares = values_in(0.0, 1.0)
    parser.add_argument(
        "--loss",
        type=shares,
        default=shares(LOSSES),
        metavar="P",
        help=f"share of the messages that is lost; several as for --delay ({LOSSES})",
    )
    parser.add_argument(
        "--trials", type=count, default=TRIALS, help=f"for each of these networks ({TRIALS})"
    )
    about = "; ".join(f"{name}: {control.about}" for name, control in CONTROLS.items())
    parser.add_argument(
        "--control",
        type=parse_controls,
        default=tuple(CONTROLS),
        metavar="NAME,...",
        help=f"which to compare (all): {about}",
    )
    parser.add_argument(
        "--lead-easing", type=finite, metavar="ALPHA", help="law.lead_easing, for all controls"
    )
    parser.add_argument(
        "--only",
        type=natural,
        metavar="NUMBER",
        help="run this trial alone; exit code 1 if it fell, whatever its control (the study's is 1 "
        "if distributed fell)",
    )
    alone = "; with --only: where the trial's log goes (default: none)"
    study.add_flags(parser, "latency", "the table and its pictures", alone)


def values_in(low: float, high: float) -> Callable[[str], tuple[float, ...]]:
    """Return a reader for argparse: `0,10,50:200:50` as numbers, rising, none twice."""

    def read(text: str) -> tuple[float, ...]:
        number = r"(\d+(?:\.\d*)?|\.\d+)"
        found: set[float] = set()
        for piece in text.split(","):
            match = re.fullmatch(rf"{number}(?::{number}:{number})?", piece.strip())
            if match is None:
                raise argparse.ArgumentTypeError(
                    f"{text!r}; write numbers such as 0,10,50, or FROM:TO:STEP such as 0:200:10"
                )
            first = float(match[1])
            last, step = (float(match[2]), float(match[3])) if match[2] else (first, 1.0)
            if last < first or step <= 0.0 or (last - first) / step > VALUES_MAX:
                raise argparse.ArgumentTypeError(
                    f"{piece!r}: FROM:TO:STEP must rise, in at most {VALUES_MAX} steps"
                )
            count = int((last - first) / step + 1e-9) + 1
            found.update(round(first + i * step, FLAG_DIGITS) for i in range(count))
        if max(found) > high or min(found) < low:
            raise argparse.ArgumentTypeError(f"{text!r}: must be from {low:g} to {high:g}")
        return tuple(sorted(found))

    return read


def parse_controls(text: str) -> tuple[str, ...]:
    """Read names with commas, for argparse."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    if unknown := [name for name in names if name not in CONTROLS]:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r}; some of {', '.join(CONTROLS)}")
    return tuple(name for name in CONTROLS if name in names)


def trials_of(args: argparse.Namespace) -> list[LatencyTrial]:
    """Return all trials, in the order of their numbers.

    The whole grid comes once, then again: an interrupted study has trials of each network, and a
    resumed one may have more trials.
    """
    networks = [Network(d, j, p) for p, j, d in product(args.loss, args.jitter, args.delay)]
    grid = list(product(range(args.trials), networks, args.control))
    return [
        LatencyTrial(number=number, repeat=repeat, seed=args.seed, control=control, network=network)
        for number, (repeat, network, control) in enumerate(grid)
    ]


def run(args: argparse.Namespace) -> int:
    """Run the study, or one trial of it; 0 if the shipped control never fell."""
    executor = study.executor_of(args, CODE)
    robot = experiment.load_robot(args.config)
    if args.lead_easing is not None:
        law = msgspec.structs.replace(robot.law, lead_easing=args.lead_easing)
        robot = msgspec.structs.replace(robot, law=law)
        check_ranges("--lead-easing", law)
    console = Console()
    trials = trials_of(args)
    if args.only is not None:
        return _run_one(args, trials, robot, console)
    return _run_all(args, trials, robot, executor, console)


def _run_all(
    args: argparse.Namespace,
    trials: list[LatencyTrial],
    robot: RobotConfig,
    executor: study.Executor,
    console: Console,
) -> int:
    drawn = [row_of(trial) for trial in trials]
    columns = [*drawn[0], *COLUMNS_OUT]
    robots = {name: robot_of(robot, name) for name in args.control}
    inputs = study.inputs(
        "latency", robot, CODE, seed=str(args.seed), delay=_joined(args.delay),
        jitter=_joined(args.jitter), loss=_joined(args.loss), control=",".join(args.control),
        ranges=plants.digest(),
    )  # fmt: skip
    finished = study.run(
        study.Study(
            "latency", TABLE, columns, LABELS, inputs, drawn, len(trials), JOB,
            f"{_command(args)} --trials {args.trials}",
        ),
        lambda done: [(t, robots[t.control]) for t in trials if t.number not in done],
        args.out, executor, console,
    )  # fmt: skip
    rows = finished.rows
    force_max = robot.simulation.operator.force_max
    pictures = latency_picture.draw(rows, force_max, f"seed {args.seed}", finished.out)
    latency_report.show(rows, _command(args), console)
    files = ", ".join((TABLE, *(path.name for path in pictures)))
    finished.show_files(files, "trial", console)
    return exit_code(row["ending"] for row in rows if row["control"] == "distributed")


def _run_one(
    args: argparse.Namespace, trials: list[LatencyTrial], robot: RobotConfig, console: Console
) -> int:
    if args.only >= len(trials):
        args.trials = 1 + args.only // (len(trials) // args.trials)
        trials = trials_of(args)
    trial = trials[args.only]
    robot = robot_of(robot, trial.control)
    study.show(f"Trial {trial.number}", row_of(trial), console)
    metadata = {"lockstep": f"{_command(args)} --only {trial.number}", "control": trial.control}
    return run_alone(
        partial(run_trial, trial, robot),
        trial.scenario(robot),
        robot,
        args.out,
        metadata,
        console,
        plant_of(trial),
    )


def row_of(trial: LatencyTrial) -> dict[str, object]:
    """Return a trial by column."""
    row: dict[str, object] = {
        "number": trial.number,
        "repeat": trial.repeat,
        "control": trial.control,
    }
    network = msgspec.structs.asdict(trial.network)
    row |= {name: plain(value) for name, value in network.items()}
    return row | {"impaired_from_s": trial.draw.impaired_from_s}


def _run_task(task: Task) -> LatencyResult:
    return run_trial(*task)


def _name(task: Task) -> str:
    trial = task[0]
    network = trial.network
    return (
        f"trial {trial.number} ({trial.control}, delay {plain(network.delay_ms)} ms, "
        f"jitter {plain(network.jitter_ms)} ms, loss {plain(network.loss)})"
    )


def _rows(task: Task, outcome: LatencyResult) -> list[dict[str, object]]:
    return [row_of(task[0]) | msgspec.structs.asdict(outcome)]


JOB: Final = study.Job(_run_task, _name, _rows, lambda row: row["ending"] != Ending.STOOD)


def _joined(values: tuple[float, ...]) -> str:
    return ",".join(map(plain, values))


def _command(args: argparse.Namespace) -> str:
    """Return the command of this study, but for --trials, --only and --out."""
    flags = [f"--seed {args.seed}"]
    for name, standard in (("delay", DELAYS_MS), ("jitter", "0"), ("loss", LOSSES)):
        if (given := _joined(getattr(args, name))) != standard:
            flags.append(f"--{name} {given}")
    if args.control != tuple(CONTROLS):
        flags.append(f"--control {','.join(args.control)}")
    if args.lead_easing is not None:
        flags.append(f"--lead-easing {args.lead_easing}")
    return study.command("latency", args, *flags)
