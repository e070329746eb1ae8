"""A study through the command line, the table that it wrote, and work for processes."""

from __future__ import annotations

import csv
import io
import os
import pickle
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import pytest

from shared.config.robot_config import RobotConfig
from tools import cli
from tools.lab.studies.sweeps import pool
from tools.lab.studies.sweeps.study import StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
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


def run_cases_here(patch: pytest.MonkeyPatch) -> None:
    """Run cases in this process, sent to themselves as to a worker: its start takes longer."""

    def results(
        work: Callable[[Any], Any], tasks: Sequence[Any], *_: object
    ) -> Iterator[tuple[Any, Any]]:
        for task in tasks:
            run, sent = pickle.loads(pickle.dumps((work, task)))  # noqa: S301 - our own
            yield task, run(sent)

    patch.setattr(pool, "results", results)


def square(number: int) -> int:
    return number * number


def stumble(number: int) -> int:
    if number == 2:
        raise ValueError("two\nlines")
    return number


def die(_number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def give_up(_number: int) -> int:
    raise CancelledError("scheduler-connection-lost.\nClient lost the connection.")
