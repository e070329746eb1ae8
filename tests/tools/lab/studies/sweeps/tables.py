"""A study through the command line, the table that it wrote, and a study that costs nothing."""

from __future__ import annotations

import csv
import io
import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from services.simulator.physics.plant import PlantConfig
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from tests.lockstep.runs import still
from tools import cli
from tools.flags import Count
from tools.lab.studies.sweeps.figures import Ended, Ending, Observer
from tools.lab.studies.sweeps.study import Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.output import Picture, new_figure
from tools.terminal import Console


def sweep(*words: object) -> int:
    return cli.main(["study", *map(str, words)])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def finished(
    rows: Sequence[Row], robot: RobotConfig, flags: StudyFlags, command: str = ""
) -> StudyRun:
    """Return a study that has run; its console prints into a text of 120 columns."""
    return StudyRun(flags, robot, command, Console(width=120, file=io.StringIO()), rows)


def printed(report: Callable[[StudyRun], None], done: StudyRun) -> str:
    """Return what a report prints."""
    report(done)
    return done.console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


class ToyFlags(StudyFlags):
    """Flags of a study whose cases cost nothing."""

    n: Count = 3
    """cases"""
    nap: float = 0.0
    """s, for each case"""


class ToyCase(msgspec.Struct, frozen=True):
    number: int
    seed: int
    nap: float

    def scenario(self, _robot: RobotConfig) -> Scenario:
        return still(1.0)

    def true_plant(self) -> PlantConfig:
        return PlantConfig()


def run_toy(case: ToyCase, _robot: RobotConfig, _observer: Observer) -> Ended:
    """Case 2 of seed 7 falls, case 2 of seed 8 fails, case 1 of seed 9 kills its process."""
    time.sleep(case.nap)
    if (case.seed, case.number) == (8, 2):
        raise ValueError("two\nlines")
    if (case.seed, case.number) == (9, 1):
        os.kill(os.getpid(), signal.SIGKILL)
    fell = (case.seed, case.number) == (7, 2)
    return Ended(ending=Ending.FELL if fell else Ending.STOOD, fell_at_s=1 / 3 if fell else None)


def draw_toy(_finished: StudyRun) -> Picture:
    return new_figure(2, 2)


TOY = Study[ToyCase](
    name="toy",
    table="toy.csv",
    cases=lambda flags, _robot: lambda number: ToyCase(number, flags.seed, flags.nap),
    figures=Ended,
    trial=run_toy,
    report=lambda done: done.console.print(f"{len(done.rows)} rows"),
    draw=draw_toy,
)


def square(number: int) -> int:
    return number * number


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds
