"""What all studies have in common: their flags, where results go, who runs them, the bar."""

from __future__ import annotations

import argparse
import hashlib
import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.studies.sweeps import cluster, pool
from tools.studies.sweeps.table import CaseTable

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
    """What is to be done with each task."""

    work: Callable[[T], R]
    """A function of a module; it runs in the workers."""
    name: Callable[[T], str]
    """What a task is called in an error."""
    rows: Callable[[T, R], Sequence[Mapping[str, object]]]
    """Its rows of the table."""
    fell: Callable[[Mapping[str, object]], bool]
    """Whether a row is of a fall."""


def add_flags(parser: argparse.ArgumentParser, name: str, files: str, more: str = "") -> None:
    """Add the flags that each study has.

    Args:
        parser: the study's.
        name: of the study.
        files: what `--out` will hold, in words.
        more: what else there is to say of `--out`.
    """
    parser.add_argument("--seed", type=int, default=1, help="of the cases (1)")
    parser.add_argument(
        "--workers", type=int, help=f"processes of this machine (one a core: {pool.cores()})"
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
        help=f"where {files} go (default: out/sweep-{name}-<time>); a study that was stopped is "
        f"gone on with{more}",
    )


def executor_of(args: argparse.Namespace, code: tuple[str, ...]) -> Executor:
    """Return who runs the study, by its flags.

    Raises:
        RunError: the flags do not go together, or make no sense.
    """
    if args.workers is not None:
        check_least(("--workers", args.workers, 1))
    if args.cluster is not None and args.workers is not None:
        raise RunError("--workers are of this machine, --cluster has its own; leave one out")
    if args.cluster is not None and getattr(args, "only", None) is not None:
        raise RunError("--only runs here, in one process; leave --cluster out")
    return Executor(args.workers or pool.cores(), args.cluster, code)


def check_least(*flags: tuple[str, int, int]) -> None:
    """Check numbers: name of the flag, value, least.

    Raises:
        RunError: one is less.
    """
    for flag, value, least in flags:
        if value < least:
            raise RunError(f"{flag} {value}: must be at least {least}")


def digest_of(robot: RobotConfig) -> str:
    """Return the SHA-256 of a robot file and of the gain schedule beside it."""
    schedule = msgspec.json.encode(robot.gain_schedule)
    return hashlib.sha256(config_file.to_toml(robot).encode() + schedule).hexdigest()


def folder(out: Path | None, name: str) -> Path:
    """Return where the results go."""
    return out or Path("out") / time.strftime(f"sweep-{name}-%Y%m%d-%H%M%S")


def results(job: Job[T, R], tasks: Sequence[T], crew: Executor) -> Iterator[tuple[T, R]]:
    """Yield each task with its result as it is done; as `pool.results`."""
    if crew.cluster is None:
        return pool.results(job.work, tasks, crew.workers, job.name)
    return cluster.results(job.work, tasks, crew.cluster, job.name, crew.code)


def fill(
    table: CaseTable,
    job: Job[T, R],
    tasks: Sequence[T],
    crew: Executor,
    total: int,
    console: Console,
) -> float:
    """Run tasks into a table under a progress bar.

    Args:
        table: takes the rows as they come.
        job: what to do with each task.
        tasks: those that are not done yet.
        crew: who does it.
        total: rows that the table is to have.
        console: for the bar.

    Returns:
        Wall time for each row, s; 0 if none was missing.

    Raises:
        RunError: as `pool.results` and `cluster.results`.
    """
    there = table.rows(total)
    if there:
        console.print(f"{len(there)} of {total} cases are done already")
    begin, new = time.monotonic(), 0
    fallen = sum(job.fell(row) for row in there)
    with bar(
        "{task.completed} of {task.total} cases, {task.fields[fallen]} fell", console
    ) as shown:
        line = shown.add_task("", total=total, completed=len(there), fallen=fallen)
        for task, result in results(job, tasks, crew):
            rows = job.rows(task, result)
            for row in rows:
                table.add(row)
                fallen += job.fell(row)
            new += len(rows)
            shown.update(line, advance=len(rows), fallen=fallen)
    return (time.monotonic() - begin) / new if new else 0.0


@contextmanager
def resumable(
    table: CaseTable, out: Path, command: str, crew: Executor, console: Console
) -> Iterator[None]:
    """Say what is kept, and how to go on, at Ctrl-C, SIGTERM and when a worker is lost.

    Args:
        table: the study's.
        out: its folder.
        command: of the study, but for who runs it and `--out`.
        crew: who runs it.
        console: to print on.
    """
    try:
        yield
    except (KeyboardInterrupt, SystemExit, RunError):
        if done := len(table.numbers):
            cluster_flag = f" --cluster {crew.cluster}" if crew.cluster else ""
            again = f"{command}{cluster_flag} --out {shlex.quote(str(out))}"
            console.print(f"{done} cases are in {out}; go on with: {again}", soft_wrap=True)
        raise


def bar(text: str, console: Console) -> Progress:
    """Return a progress bar with the time left."""
    return Progress(
        BarColumn(), TextColumn(text), TimeRemainingColumn(), console=console, transient=True
    )


def show(title: str, figures: Mapping[str, object], console: Console) -> None:
    """Print figures, one a line, but for those that are None."""
    console.print(f"[bold]{title}[/]")
    for name, value in figures.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            console.print(f"  {name:24} {text}", highlight=False)
