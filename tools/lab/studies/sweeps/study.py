"""The runner that all studies share, on this machine or on a cluster.

It draws the cases, runs those that the table lacks, writes each row when it is done, and reports.
"""

from __future__ import annotations

import hashlib
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Generic, NamedTuple, TypeVar

import msgspec
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from shared.bus.traces import SimTruth
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.extras import require
from shared.places import DEFAULT_CONFIG
from tools.flags import Arg, ConfigFlags, Count, Folder, Natural, fields_of
from tools.judge.figure import judge_run
from tools.lab.studies.sweeps import plants, pool
from tools.lab.studies.sweeps.figures import (
    EXIT_CODES,
    Case,
    Ending,
    Observer,
    parted,
    scalars,
    wilson,
    worst,
)
from tools.lab.studies.sweeps.table import CaseTable, Row, plain
from tools.live import experiment
from tools.output import Picture, save_figure
from tools.sim.recorded_lockstep import AFTER_FALL_S, record_run
from tools.terminal import Console, marked

FALLS_SHOWN: Final = 10
FALL_COLOUR: Final = "#c0392b"
NOT_THE_STUDY: Final = ("n", "config", "seed", "only", "workers", "cluster", "out")
"""Flags that `command_of` leaves out or writes separately."""


C = TypeVar("C", bound=Case)


class StudyFlags(ConfigFlags):
    """Flags of all studies."""

    seed: Natural = 1
    """seed of the cases"""
    workers: Annotated[Count | None, Arg(metavar="N")] = None
    """processes on this machine (default: one per core)"""
    cluster: Annotated[str | None, Arg(metavar="ADDRESS")] = None
    """run on a Dask scheduler's workers, such as tcp://HOST:8786; each needs this project and one
    thread"""
    out: Folder | None = None
    """folder for table and picture, in which an interrupted study resumes (default:
    out/sweep-NAME-<time>)"""
    only: Annotated[Natural | None, Arg(metavar="NUMBER")] = None
    """run only this case and print it; --out stores its log, except for `study push`"""

    def check(self) -> None:
        """Refuse contradictory flags about where to run."""
        super().check()
        if self.cluster is not None and self.workers is not None:
            raise RunError("--workers is for this machine, --cluster for others; remove one")
        if self.cluster is not None and self.only is not None:
            raise RunError("--only runs here, in one process; remove --cluster")


class StudyRun(NamedTuple):
    """A running study; once it has its rows, the input of its report."""

    flags: Any
    robot: RobotConfig
    command: str
    """Command that runs one case alone, if `--only` and its number are added."""
    console: Console
    rows: Sequence[Row] = ()


class Study(msgspec.Struct, Generic[C], frozen=True, kw_only=True):
    """The properties that distinguish one study from the others."""

    name: str
    """Word after `xrl study`."""
    case: str = "case"
    """Word for a case."""
    table: str
    """File name of the table; the picture has the same name."""
    load: Callable[[Any], RobotConfig] = lambda flags: experiment.load_robot(flags.config)
    total: Callable[[Any], int] = lambda flags: int(flags.n)
    """Number of cases."""
    cases: Callable[[Any, RobotConfig], Callable[[int], C]]
    """Returns the function that draws the case with a number, independently of other draws."""
    decided_by: tuple[str, ...] = ()
    """Flags that affect the rows, besides seed, robot and code; a folder with other values is
    refused."""
    row: Callable[[Any], dict[str, object]] = scalars
    """The draws of a case by column, its number first."""
    figures: type[msgspec.Struct]
    """The results of a case: the other columns."""
    trial: Callable[[C, RobotConfig, Observer], msgspec.Struct]
    """Runs a case on its robot; must be a module-level function."""
    robots: Callable[[Sequence[C], RobotConfig, int, Console], Sequence[RobotConfig]] = (
        lambda cases, robot, _workers, _console: [robot] * len(cases)
    )
    """Returns the robot of each case, prepared in the given number of processes."""
    report: Callable[[StudyRun], None]
    """Prints the outcome."""
    draw: Callable[[StudyRun], Picture]
    exit_code: Callable[[Row], int] = lambda row: EXIT_CODES[row["ending"]]
    """Exit code of one row of the study; the study's is the `worst` of all."""


def run(study: Study[C], flags: Any) -> int:
    """Run a study, or one case of it; return the exit code.

    Raises:
        RunError: the folder contains another study, a case failed, or a worker was lost.
    """
    require("sim")
    robot = study.load(flags)
    case_of = study.cases(flags, robot)
    begun = StudyRun(flags, robot, command_of(study, flags), Console())
    if flags.only is not None:
        return _run_alone(study, begun, case_of(flags.only))
    drawn = [case_of(number) for number in range(study.total(flags))]
    out = flags.out or Path("out") / time.strftime(f"sweep-{study.name}-%Y%m%d-%H%M%S")
    inputs = {
        "study": study.name,
        **{name: _text(getattr(flags, name)) for name in ("seed", *study.decided_by)},
        "ranges": hashlib.sha256(plants.RANGES_FILE.read_bytes()).hexdigest(),
        "robot": digest_of(robot),
        "code": pool.code_digest(),
    }
    with CaseTable(out / study.table, list(map(study.row, drawn)), study.figures, inputs) as table:
        try:
            case_s = _fill(table, study, begun, drawn)
        except (KeyboardInterrupt, SystemExit, RunError):
            if done := len(table.numbers):
                count = getattr(flags, "n", None)
                many = [] if count is None else [f"--n {count}"]
                many += [f"--cluster {flags.cluster}"] if flags.cluster else []
                again = " ".join([begun.command, *many, f"--out {shlex.quote(str(out))}"])
                begun.console.print(
                    f"{done} of {len(drawn)} cases are in {out}; resume with: {again}",
                    soft_wrap=True,
                )
            raise
        finished = begun._replace(rows=table.rows)
    study.report(finished)
    picture = (out / study.table).with_suffix(".png")
    save_figure(study.draw(finished), picture)
    pace = f"; {case_s:.2f} s per {study.case}" if case_s else ""
    finished.console.print(
        f"{out}/{study.table}, {picture.name}{pace}", style="dim", soft_wrap=True
    )
    return worst(study.exit_code(row) for row in finished.rows)


def _fill(table: CaseTable, study: Study[C], begun: StudyRun, drawn: Sequence[C]) -> float:
    """Run the cases that a table lacks into it; return the wall time per case, s."""
    flags, robot, command, console, _ = begun
    done, workers = table.rows, flags.workers or pool.cores()
    fallen = sum(map(_fell, done))
    if done:
        console.print(f"{len(done)} of {len(drawn)} cases are already done")
    missing = [case for case in drawn if case.number not in table.numbers]
    robots = study.robots(missing, robot, workers, console)
    results = pool.results(
        partial(_run_task, study.trial),
        list(zip(missing, robots, strict=True)),
        workers,
        lambda task: f"{study.case} {task[0].number} ({command} --only {task[0].number})",
        flags.cluster,
    )
    text = "{task.completed} of {task.total} cases, {task.fields[fallen]} fell"
    begin = time.monotonic()
    with bar(text, console) as shown:
        line = shown.add_task("", total=len(drawn), completed=len(done), fallen=fallen)
        for (case, _), figures in results:
            fallen += _fell(table.add(study.row(case), figures))
            shown.update(line, advance=1, fallen=fallen)
    return (time.monotonic() - begin) / len(missing) if missing else 0.0


def _fell(row: Row) -> bool:
    return bool(row.get("ending", Ending.STOOD) != Ending.STOOD)


def _run_task(
    trial: Callable[[C, RobotConfig, Observer], msgspec.Struct], task: tuple[C, RobotConfig]
) -> msgspec.Struct:
    return trial(*task, Observer())


def _run_alone(study: Study[C], begun: StudyRun, case: C) -> int:
    """Run a case; with `--out` it is recorded and judged like a run of `xrl sim`."""
    flags, robot, command, console, _ = begun
    (robot,) = study.robots([case], robot, 1, console)
    show(f"{study.case.capitalize()} {case.number}, drawn", study.row(case), console)
    scenario, out = case.scenario(robot), flags.out
    with bar("{task.completed:.1f} of {task.total:.1f} s", console) as shown:
        line = shown.add_task("", total=scenario.duration)

        def watch(truth: SimTruth) -> None:
            shown.update(line, completed=max(0.0, truth.scenario_s))

        if out is None:
            figures = study.trial(case, robot, Observer(watch=watch))
        else:
            experiment.make_out(out, "sweep")
            figures = record_run(
                scenario,
                robot,
                out,
                {"lockstep": f"{command} --only {case.number}"},
                lambda record, each: study.trial(case, robot, Observer(record, each, AFTER_FALL_S)),
                watch,
                case.true_plant(),
            )
            judge_run(out, f"{scenario.name} in lockstep", scenario.duration)
    show("Measured", msgspec.structs.asdict(figures), console)
    if out is not None:
        console.print(f"{out}/run.mcap, run.png, summary.json", style="dim", soft_wrap=True)
    ending = getattr(figures, "ending", Ending.STOOD)
    console.print(marked("[bold]{}[/]", ending))
    return EXIT_CODES[ending]


def command_of(study: Study[Any], flags: Any) -> str:
    """Return the command of a study with the flags that differ from their defaults.

    It leaves out `--only`, the number of cases, where they run, and `--out`.
    """
    words = [f"xrl study {study.name} --seed {flags.seed}"]
    for field in fields_of(type(flags)):
        value, flag = getattr(flags, field.name), f"--{field.name.replace('_', '-')}"
        if field.name in NOT_THE_STUDY or value == field.default:
            continue
        if value is True:
            words.append(flag)
        else:
            several = value if field.is_repeated else [value]
            words += [f"{flag} {shlex.quote(_text(one))}" for one in several]
    if flags.config != DEFAULT_CONFIG:
        words.append(f"--config {flags.config}")
    return " ".join(words)


def _text(value: object) -> str:
    """Return a flag's value as written on the command line."""
    if isinstance(value, tuple):
        return ",".join(plain(one) if isinstance(one, float) else str(one) for one in value)
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def digest_of(robot: RobotConfig) -> str:
    """Return the SHA-256 of a robot file and of the gain schedule beside it."""
    schedule = msgspec.json.encode(robot.gain_schedule)
    return hashlib.sha256(config_file.to_toml(robot).encode() + schedule).hexdigest()


def bar(text: str, console: Console) -> Progress:
    """Return a progress bar with the time left."""
    return Progress(
        BarColumn(), TextColumn(text), TimeRemainingColumn(), console=console, transient=True
    )


def show(title: str, values: Mapping[str, object], console: Console) -> None:
    """Print values, one per line, without those that are None."""
    console.print(marked("[bold]{}[/]", title))
    for name, value in values.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            console.print(f"  {name:24} {text}", highlight=False)


def show_outcome(
    finished: StudyRun,
    figures: Sequence[tuple[str, str, str, float]],
    describe: Callable[[Row], str],
) -> None:
    """Print the falls, the median and worst figures of the other cases, and the fraction of falls.

    `figures` are column, description, unit, and the sign of the worse direction; `describe`
    returns a case in one line.
    """
    rows, console, command = finished.rows, finished.console, finished.command
    standing, fallen = parted(rows)
    for row in fallen[:FALLS_SHOWN]:
        console.print(marked("[red]{}[/] {}", row["ending"], describe(row)), highlight=False)
        console.print(f"    {command} --only {row['number']}", style="dim", soft_wrap=True)
    if len(fallen) > FALLS_SHOWN:
        console.print(f"... and {len(fallen) - FALLS_SHOWN} more in the table")
    printed = Table(title="Cases that stood", title_justify="left")
    for heading in ("what", "median", "worst", "", "case"):
        printed.add_column(heading, justify="left" if heading in ("what", "") else "right")
    for column, words, unit, sign in figures:
        known = sorted(
            (row for row in standing if row[column] is not None),
            key=lambda row: sign * float(row[column]),
        )
        if known:
            middle, last = known[len(known) // 2], known[-1]
            printed.add_row(words, f"{middle[column]:.3g}", f"{last[column]:.3g}", unit,
                            str(last["number"]))  # fmt: skip
    if standing:
        console.print(printed)
    low, high = wilson(len(fallen), len(rows))
    colour = "red" if fallen else "green"
    text = (
        f"[bold {colour}]{{}} of {{}} fell[/]; fraction of falls {{:.2f}} to {{:.2f}} % "
        "(95 %, Wilson)"
    )
    console.print(marked(text, len(fallen), len(rows), 100 * low, 100 * high), highlight=False)
