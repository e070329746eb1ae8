"""The frame of every study: flags, workers, the table of cases, resuming, the progress bar."""

from __future__ import annotations

import argparse
import hashlib
import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import msgspec
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.places import DEFAULT_CONFIG
from tools.lab.studies.sweeps import cluster, pool
from tools.lab.studies.sweeps.table import CaseTable, Row, Words, code_digest
from tools.number_arguments import count, natural
from tools.terminal import Console, marked

T = TypeVar("T")
R = TypeVar("R")


class Executor(NamedTuple):
    """Who runs a study."""

    workers: int
    """Processes of this machine."""
    cluster: str | None
    """Address of a Dask scheduler; None: this machine alone."""
    code: tuple[str, ...]
    """What decides an outcome: a cluster's workers must have the same."""


class Job(NamedTuple, Generic[T, R]):
    """How a task is done."""

    work: Callable[[T], R]
    """A function of a module; it runs in the workers."""
    name: Callable[[T], str]
    """Name of a task in an error."""
    rows: Callable[[T, R], Sequence[Mapping[str, object]]]
    """Its rows of the table."""
    fell: Callable[[Mapping[str, object]], bool]
    """True for the row of a fall."""


class Study(NamedTuple, Generic[T, R]):
    """A study to run: one row per case, appended on completion; an interrupted study resumes."""

    name: str
    """Its name after `xrl study sweep`."""
    table: str
    """File name of the table."""
    columns: Sequence[str]
    """The first is the case's number."""
    words: Words
    """Columns that hold words, and the words that each may hold."""
    inputs: Mapping[str, str]
    """Parameters of the rows; a folder with others is refused."""
    drawn: Sequence[Mapping[str, object]]
    """By case: the start of its row, known before it runs."""
    total: int
    """Number of cases."""
    job: Job[T, R]
    command: str
    """Resumes it, but for `--out`."""


class Finished(NamedTuple):
    """A study that has run."""

    rows: list[Row]
    out: Path
    case_s: float
    """Wall time for each new case, s; 0 if there was none."""

    def show_files(self, files: str, case: str, console: Console) -> None:
        """Print where the results are and the time that a case took.

        Args:
            files: the table and the pictures, as text.
            case: name of a case, such as "trial".
            console: to print on.
        """
        pace = f"; {self.case_s:.2f} s a {case}" if self.case_s else ""
        console.print(f"{self.out}/{files}{pace}", style="dim", soft_wrap=True)


def add_flags(parser: argparse.ArgumentParser, name: str, files: str, more: str = "") -> None:
    """Add the flags that each study has.

    Args:
        parser: the study's.
        name: of the study.
        files: what `--out` will hold, in words.
        more: what else there is to say of `--out`.
    """
    parser.add_argument("--seed", type=natural, default=1, help="of the cases (1)")
    parser.add_argument(
        "--workers", type=count, help=f"processes of this machine (one a core: {pool.cores()})"
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="run on the workers of a Dask scheduler instead, such as tcp://HOST:8786; they need "
        "this project installed, and one thread each",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"where {files} go (default: out/sweep-{name}-<time>); an interrupted study resumes "
        f"there{more}",
    )


def executor_of(args: argparse.Namespace, code: tuple[str, ...]) -> Executor:
    """Return who runs the study, by its flags.

    Raises:
        RunError: the flags do not go together, or make no sense.
    """
    if args.cluster is not None and args.workers is not None:
        raise RunError("--workers are of this machine, --cluster has its own; leave one out")
    if args.cluster is not None and getattr(args, "only", None) is not None:
        raise RunError("--only runs here, in one process; leave --cluster out")
    return Executor(args.workers or pool.cores(), args.cluster, code)


def digest_of(robot: RobotConfig) -> str:
    """Return the SHA-256 of a robot file and of the gain schedule beside it."""
    schedule = msgspec.json.encode(robot.gain_schedule)
    return hashlib.sha256(config_file.to_toml(robot).encode() + schedule).hexdigest()


def inputs(name: str, robot: RobotConfig, code: tuple[str, ...], **more: str) -> dict[str, str]:
    """Return the parameters of a study's rows: robot, code, and those given."""
    return {"study": name, **more, "robot": digest_of(robot), "code": code_digest(code)}


def command(name: str, args: argparse.Namespace, *flags: str) -> str:
    """Return the command of a study, with `--config` if it is not the shipped robot's."""
    config = [] if args.config == DEFAULT_CONFIG else [f"--config {args.config}"]
    return " ".join([f"xrl study sweep {name}", *flags, *config])


def run(
    study: Study[T, R],
    tasks_but: Callable[[set[int]], Sequence[T]],
    out: Path | None,
    executor: Executor,
    console: Console,
) -> Finished:
    """Run the cases that the table lacks; at an interruption, print how to resume.

    Args:
        study: what to run.
        tasks_but: returns the tasks, but for those of cases that are done.
        out: folder of the results; None: a new one.
        executor: who runs the tasks.
        console: for the bar.

    Raises:
        RunError: the folder holds another study, a task failed, or a worker was lost.
    """
    folder = out or Path("out") / time.strftime(f"sweep-{study.name}-%Y%m%d-%H%M%S")
    with CaseTable(
        folder, study.table, study.columns, study.inputs, study.words, study.drawn
    ) as table:
        try:
            case_s = _fill(table, study, tasks_but(table.numbers), executor, console)
        except (KeyboardInterrupt, SystemExit, RunError):
            if done := len(table.numbers):
                flag = f" --cluster {executor.cluster}" if executor.cluster else ""
                again = f"{study.command}{flag} --out {shlex.quote(str(folder))}"
                console.print(f"{done} cases are in {folder}; resume with: {again}", soft_wrap=True)
            raise
    return Finished(table.rows(study.total), folder, case_s)


def _fill(
    table: CaseTable,
    study: Study[T, R],
    tasks: Sequence[T],
    executor: Executor,
    console: Console,
) -> float:
    """Run tasks into a table; return the wall time for each new row, s."""
    job, done = study.job, table.rows(study.total)
    if done:
        console.print(f"{len(done)} of {study.total} cases are done already")
    start, new = time.monotonic(), 0
    fallen = sum(job.fell(row) for row in done)
    text = "{task.completed} of {task.total} cases, {task.fields[fallen]} fell"
    with bar(text, console) as shown:
        line = shown.add_task("", total=study.total, completed=len(done), fallen=fallen)
        for task, result in _results(job, tasks, executor):
            rows = job.rows(task, result)
            for row in rows:
                table.add(row)
                fallen += job.fell(row)
            new += len(rows)
            shown.update(line, advance=len(rows), fallen=fallen)
    return (time.monotonic() - start) / new if new else 0.0


def _results(job: Job[T, R], tasks: Sequence[T], executor: Executor) -> Iterator[tuple[T, R]]:
    if executor.cluster is None:
        return pool.results(job.work, tasks, executor.workers, job.name)
    return cluster.results(job.work, tasks, executor.cluster, job.name, executor.code)


def bar(text: str, console: Console) -> Progress:
    """Return a progress bar with the time left."""
    return Progress(
        BarColumn(), TextColumn(text), TimeRemainingColumn(), console=console, transient=True
    )


def show(title: str, figures: Mapping[str, object], console: Console) -> None:
    """Print figures, one a line, but for those that are None."""
    console.print(marked("[bold]{}[/]", title))
    for name, value in figures.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            console.print(f"  {name:24} {text}", highlight=False)
