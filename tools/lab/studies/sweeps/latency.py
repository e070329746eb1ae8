"""`xrl study sweep latency`: three controls over networks from good to hopeless, under pushes."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Final

import msgspec

from shared.config.robot_config import RobotConfig
from shared.toml_file import check_ranges
from tools.lab.studies.sweeps import latency_picture, latency_report, latency_trial, plants
from tools.lab.studies.sweeps.latency_trial import (
    CONTROLS,
    LatencyResult,
    LatencyTrial,
    Network,
    robot_of,
)
from tools.lab.studies.sweeps.study import CaseLog, Finished, Study
from tools.lab.studies.sweeps.table import DECIMALS
from tools.live import experiment
from tools.number_arguments import count, finite
from tools.terminal import Console

DELAYS_MS: Final = "0,10,20,30,50,100,200"
LOSSES: Final = "0,0.1,0.3,0.5"
TRIALS: Final = 4
DELAY_MAX_MS: Final = 60_000.0
VALUES_MAX: Final = 1000


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's own flags."""
    delays, shares = values_in(0.0, DELAY_MAX_MS), values_in(0.0, 1.0)
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
            steps = int((last - first) / step + 1e-9)
            found.update(round(first + i * step, DECIMALS) for i in range(steps + 1))
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


def load(args: argparse.Namespace) -> RobotConfig:
    """Return the robot with the easing that was asked for."""
    robot = experiment.load_robot(args.config)
    if args.lead_easing is not None:
        law = msgspec.structs.replace(robot.law, lead_easing=args.lead_easing)
        robot = msgspec.structs.replace(robot, law=law)
        check_ranges("--lead-easing", law)
    return robot


def grid_of(args: argparse.Namespace) -> list[tuple[Network, str]]:
    """Return each network with each control."""
    networks = [Network(d, j, p) for p, j, d in product(args.loss, args.jitter, args.delay)]
    return list(product(networks, args.control))


def trial_of(grid: Sequence[tuple[Network, str]], seed: int, number: int) -> LatencyTrial:
    """Return the trial of a number.

    The whole grid comes once, then again: an interrupted study has trials of each network, and a
    resumed one may have more trials.
    """
    repeat, place = divmod(number, len(grid))
    network, control = grid[place]
    return LatencyTrial(number=number, repeat=repeat, seed=seed, control=control, network=network)


def _robots(
    trials: Sequence[LatencyTrial], robot: RobotConfig, _workers: int, _console: Console
) -> list[RobotConfig]:
    by_control = {name: robot_of(robot, name) for name in CONTROLS}
    return [by_control[trial.control] for trial in trials]


def _report(finished: Finished) -> None:
    force_max = finished.robot.simulation.operator.force_max
    seed = f"seed {finished.args.seed}"
    latency_picture.draw(finished.rows, force_max, seed, finished.out)
    latency_report.show(finished.rows, finished.command, finished.console)


STUDY: Final = Study[LatencyTrial](
    name="latency",
    case="trial",
    table="latency.csv",
    pictures=(latency_picture.FALLS, latency_picture.EFFORT),
    code=("tools.lab.studies.sweeps.latency_trial",),
    only="run this trial alone; exit code 1 if it fell, whatever its control (the study's is 1 if "
    "distributed fell)",
    add_flags=add_flags,
    load=load,
    total=lambda args: args.trials * len(grid_of(args)),
    cases=lambda args, _robot: partial(trial_of, grid_of(args), args.seed),
    decided_by=("seed", "delay", "jitter", "loss", "control"),
    inputs=lambda _args: {"ranges": plants.digest()},
    row=latency_trial.row_of,
    figures=LatencyResult,
    trial=latency_trial.run_trial,
    robots=_robots,
    log=CaseLog(
        lambda robot, trial: trial.scenario(robot),
        latency_trial.plant_of,
        lambda trial, command: {"lockstep": command, "control": trial.control},
    ),
    report=_report,
    counts=lambda row: row["control"] == "distributed",
)
