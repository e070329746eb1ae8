"""`xrl study latency`: three controls over networks from good to hopeless, under pushes."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Annotated, Final

import msgspec

from shared.config.robot_config import RobotConfig
from shared.toml_file import check_ranges
from tools.flags import Arg, Count, Number, parsed
from tools.lab.studies.sweeps import latency_report, latency_trial, plants, study
from tools.lab.studies.sweeps.latency_trial import (
    CONTROLS,
    LatencyResult,
    LatencyTrial,
    Network,
    robot_of,
)
from tools.lab.studies.sweeps.study import AloneFlags, CaseLog, Study
from tools.lab.studies.sweeps.table import DECIMALS
from tools.live import experiment
from tools.terminal import Console

DELAYS_MS: Final = "0,10,20,30,50,100,200"
LOSSES: Final = "0,0.1,0.3,0.5"
TRIALS: Final = 4
DELAY_MAX_MS: Final = 60_000.0
VALUES_MAX: Final = 1000


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


_DELAYS: Final = values_in(0.0, DELAY_MAX_MS)
_SHARES: Final = values_in(0.0, 1.0)

EXAMPLES: Final = """
xrl study latency
xrl study latency --delay 0:200:10 --jitter 5 --loss 0,0.2 --n 10 --out out/latency
xrl study latency --control distributed --delay 0:60:5 --loss 0 --lead-easing 0
xrl study latency --only 137 --out out/trial137
xrl study latency --cluster tcp://HOST:8786
"""


class LatencyStudyFlags(AloneFlags):
    """Which networks and controls."""

    delay: Annotated[
        tuple[float, ...],
        parsed(
            _DELAYS, "MS", is_one=True,
            help="delay of every link, each way: numbers and A:B:STEP, with commas "
            f"(default: {DELAYS_MS})",
        ),
    ] = _DELAYS(DELAYS_MS)  # fmt: skip
    jitter: Annotated[tuple[float, ...], parsed(_DELAYS, "MS", is_one=True)] = (0.0,)
    """half the width of a uniform spread; several as for --delay (default: 0)"""
    loss: Annotated[
        tuple[float, ...],
        parsed(
            _SHARES, "P", is_one=True,
            help="share of the messages that is lost; several as for --delay "
            f"(default: {LOSSES})",
        ),
    ] = _SHARES(LOSSES)  # fmt: skip
    n: Count = TRIALS
    """trials of each network"""
    control: Annotated[
        tuple[str, ...],
        parsed(
            parse_controls, "NAME,...", is_one=True,
            help="which to compare (default: all): "
            + "; ".join(f"{name}: {control.about}" for name, control in CONTROLS.items()),
        ),
    ] = tuple(CONTROLS)  # fmt: skip
    lead_easing: Annotated[Number | None, Arg(metavar="ALPHA")] = None
    """law.lead_easing, for all controls"""


def load(flags: LatencyStudyFlags) -> RobotConfig:
    """Return the robot with the easing that was asked for."""
    robot = experiment.load_robot(flags.config)
    if flags.lead_easing is not None:
        law = msgspec.structs.replace(robot.law, lead_easing=flags.lead_easing)
        robot = msgspec.structs.replace(robot, law=law)
        check_ranges("--lead-easing", law)
    return robot


def grid_of(flags: LatencyStudyFlags) -> list[tuple[Network, str]]:
    """Return each network with each control."""
    networks = [Network(d, j, p) for p, j, d in product(flags.loss, flags.jitter, flags.delay)]
    return list(product(networks, flags.control))


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


STUDY: Final = Study[LatencyTrial](
    name="latency",
    case="trial",
    table="latency.csv",
    pictures={
        "latency-falls.png": latency_report.draw_falls,
        "latency-effort.png": latency_report.draw_effort,
    },
    load=load,
    total=lambda flags: flags.n * len(grid_of(flags)),
    cases=lambda flags, _robot: partial(trial_of, grid_of(flags), flags.seed),
    decided_by=("seed", "delay", "jitter", "loss", "control"),
    inputs=lambda _flags: {"ranges": plants.digest()},
    row=latency_trial.row_of,
    figures=LatencyResult,
    trial=latency_trial.run_trial,
    robots=_robots,
    log=CaseLog(
        lambda robot, trial: trial.scenario(robot),
        latency_trial.plant_of,
        lambda trial, command: {"lockstep": command, "control": trial.control},
    ),
    report=latency_report.show,
    counts=lambda row: row["control"] == "distributed",
)


def run(flags: LatencyStudyFlags) -> int:
    """Run the study, or one case of it."""
    return study.run(STUDY, flags)
