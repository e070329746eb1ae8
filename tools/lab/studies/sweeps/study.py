"""A study as a table, and the one runner of all of them.

The runner draws the cases, runs those that the table lacks on this
machine or on a cluster, writes each row as it is done, and reports.
"""

from __future__ import annotations

import hashlib
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Generic, NamedTuple, Protocol, TypeVar

import msgspec
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from services.simulator.physics.plant import PlantConfig
from shared.bus.traces import SimTruth
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.exceptions import RunError
from shared.extras import require
from shared.places import DEFAULT_CONFIG
from tools.flags import Arg, ConfigFlags, Count, Folder, Natural, fields_of
from tools.lab.studies.sweeps import pool
from tools.lab.studies.sweeps.figures import EXIT_CODES, Ending, Observer, scalars, worst
from tools.lab.studies.sweeps.table import CaseTable, Row, code_digest, code_of, plain
from tools.live import experiment
from tools.output import Picture, save_figure
from tools.sim.recorded_lockstep import AFTER_FALL_S, judge_in_lockstep, record_run
from tools.terminal import Console, marked


class Numbered(Protocol):
    """A case."""

    @property
    def number(self) -> int:
        """From 0 on."""


C = TypeVar("C", bound=Numbered)

NOT_THE_STUDY: Final = ("n", "config", "seed", "only", "workers", "cluster", "out")
"""Those that `command_of` leaves out, or writes apart."""


class StudyFlags(ConfigFlags):
    """What all studies have."""

    seed: Natural = 1
    """of the cases"""
    workers: Annotated[Count | None, Arg(metavar="N")] = None
    """processes of this machine (default: one a core)"""
    cluster: Annotated[str | None, Arg(metavar="ADDRESS")] = None
    """run on the workers of a Dask scheduler instead, such as tcp://HOST:8786; each needs this
    project installed, and one thread"""
    out: Folder | None = None
    """folder of the table and the pictures (default: out/sweep-NAME-<time>); an interrupted study
    resumes there"""

    def check(self) -> None:
        """Refuse two places to run on."""
        super().check()
        if self.cluster is not None and self.workers is not None:
            raise RunError("--workers are of this machine, --cluster has its own; leave one out")


class AloneFlags(StudyFlags):
    """Those of a study whose cases also run alone."""

    only: Annotated[Natural | None, Arg(metavar="NUMBER")] = None
    """run only this case and print all of it; exit code 1 if it fell; with --out its log goes there
    (default: none)"""

    def check(self) -> None:
        """Refuse a case alone on a cluster."""
        super().check()
        if self.cluster is not None and self.only is not None:
            raise RunError("--only runs here, in one process; leave --cluster out")


class StudyRun(NamedTuple):
    """A study that runs; with its rows, once it has, for its report."""

    flags: Any
    robot: RobotConfig
    command: str
    """Runs one case alone, but for `--only` and its number."""
    console: Console
    rows: Sequence[Row] = ()


class CaseLog(NamedTuple, Generic[C]):
    """What the log of a case that runs alone needs."""

    scenario: Callable[[RobotConfig, C], Scenario]
    plant: Callable[[C], PlantConfig]
    metadata: Callable[[C, str], dict[str, str]]
    """By the case and its command, as for `record_run`."""


def _load(flags: Any) -> RobotConfig:
    return experiment.load_robot(flags.config)


class Study(msgspec.Struct, Generic[C], frozen=True, kw_only=True):
    """What one study has of its own."""

    name: str
    """After `xrl study`."""
    case: str = "case"
    """What a case is called."""
    table: str
    """File name of the table."""
    pictures: Mapping[str, Callable[[StudyRun], Picture]] = {}
    """What draws each, by file name."""
    load: Callable[[Any], RobotConfig] = _load
    """Returns the robot."""
    total: Callable[[Any], int] = lambda flags: int(flags.n)
    """How many cases there are."""
    cases: Callable[[Any, RobotConfig], Callable[[int], C]]
    """Returns what draws the case of a number, whatever was drawn before."""
    decided_by: tuple[str, ...] = ()
    """Flags that decide the rows, beside robot and code; a folder of others is refused."""
    inputs: Callable[[Any], dict[str, str]] = lambda _flags: {}
    """What else decides them."""
    row: Callable[[Any], dict[str, object]] = scalars
    """The draws of a case by column, its number first."""
    words: Callable[[C], str] = lambda _case: ""
    """Says which case it is, where `--only` cannot."""
    figures: type[msgspec.Struct]
    """What comes of a case: the other columns."""
    trial: Callable[..., msgspec.Struct]
    """Runs a case: a function of the module that decides how it comes out (`code`), of the case,
    its robot, and the options."""
    options: Callable[[Any], dict[str, Any]] = lambda _flags: {}
    robots: Callable[[Sequence[C], RobotConfig, int, Console], Sequence[RobotConfig]] = (
        lambda cases, robot, _workers, _console: [robot] * len(cases)
    )
    """The robot of each case, prepared by so many processes."""
    log: CaseLog[C] | None = None
    """None: a case alone has no log."""
    fell: Callable[[Row], bool] = lambda row: row["ending"] is not Ending.STOOD
    report: Callable[[StudyRun], None]
    """Prints what came of it."""
    counts: Callable[[Row], bool] = lambda _row: True
    """True for a row of the study that decides its exit code."""
    exit_code: Callable[[Row], int] = lambda row: EXIT_CODES[row["ending"]]
    """Exit code of one row; the study's is the `worst` of all."""

    @property
    def code(self) -> tuple[str, ...]:
        """All of our code that decides how a case comes out."""
        return code_of(self.trial.__module__)


def run(study: Study[C], flags: Any) -> int:
    """Run a study, or one case of it; return the exit code.

    Raises:
        RunError: the folder holds another study, a case failed, or a worker was lost.
    """
    require("sim")
    only = getattr(flags, "only", None)
    robot = study.load(flags)
    case_of = study.cases(flags, robot)
    begun = StudyRun(flags, robot, command_of(study, flags), Console())
    if only is not None:
        return _run_alone(study, begun, case_of(only))
    drawn = [case_of(number) for number in range(study.total(flags))]
    out = flags.out or Path("out") / time.strftime(f"sweep-{study.name}-%Y%m%d-%H%M%S")
    inputs = {
        "study": study.name,
        **{name: _text(getattr(flags, name)) for name in study.decided_by},
        **study.inputs(flags),
        "robot": digest_of(robot),
        "code": code_digest(study.code),
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
                said = f"{done} cases are in {out}; resume with: {again}"
                begun.console.print(said, soft_wrap=True)
            raise
        finished = begun._replace(rows=table.rows)
    pace = f"; {case_s:.2f} s a {study.case}" if case_s else ""
    study.report(finished)
    for name, draw in study.pictures.items():
        save_figure(draw(finished), out / name)
    files = ", ".join((study.table, *study.pictures))
    finished.console.print(f"{out}/{files}{pace}", style="dim", soft_wrap=True)
    return worst(study.exit_code(row) for row in finished.rows if study.counts(row))


def _fill(table: CaseTable, study: Study[C], begun: StudyRun, drawn: Sequence[C]) -> float:
    """Run the cases that a table lacks into it; return the wall time for each, s."""
    flags, robot, command, console, _ = begun
    done, workers = table.rows, flags.workers or pool.cores()
    fallen = sum(map(study.fell, done))
    if done:
        console.print(f"{len(done)} of {len(drawn)} cases are done already")
    missing = [case for case in drawn if case.number not in table.numbers]
    robots = study.robots(missing, robot, workers, console)
    results = pool.results(
        partial(_run_task, partial(study.trial, **study.options(flags))),
        list(zip(missing, robots, strict=True)),
        pool.Cluster(flags.cluster, study.code) if flags.cluster else workers,
        lambda task: _name_of(study, task[0], command),
    )
    text = "{task.completed} of {task.total} cases, {task.fields[fallen]} fell"
    begin = time.monotonic()
    with bar(text, console) as shown:
        line = shown.add_task("", total=len(drawn), completed=len(done), fallen=fallen)
        for (case, _), figures in results:
            fallen += study.fell(table.add(study.row(case), figures))
            shown.update(line, advance=1, fallen=fallen)
    return (time.monotonic() - begin) / len(missing) if missing else 0.0


def _run_task(trial: Callable[..., msgspec.Struct], task: tuple[C, RobotConfig]) -> msgspec.Struct:
    return trial(*task)


def _name_of(study: Study[C], case: C, command: str) -> str:
    """Return the name of a case in an error."""
    alone = f"{command} --only {case.number}" if not study.words(case) else study.words(case)
    return f"{study.case} {case.number} ({alone})"


def _run_alone(study: Study[C], begun: StudyRun, case: C) -> int:
    """Run a case, recorded and judged like a run of `xrl sim` if it is asked for."""
    flags, robot, command, console, _ = begun
    begin = study.row(case)
    (robot,) = study.robots([case], robot, 1, console)
    show(f"{study.case.capitalize()} {begin['number']}, drawn", begin, console)
    trial = partial(study.trial, case, robot, **study.options(flags))
    asked, out = study.log, flags.out
    if asked is None:
        figures = trial()
    else:
        scenario = asked.scenario(robot, case)
        with bar("{task.completed:.1f} of {task.total:.1f} s", console) as shown:
            line = shown.add_task("", total=scenario.duration)

            def watch(truth: SimTruth) -> None:
                shown.update(line, completed=max(0.0, truth.scenario_s))

            if out is None:
                figures = trial(Observer(watch=watch))
            else:
                experiment.make_out(out, "sweep")
                figures = record_run(
                    scenario,
                    robot,
                    out,
                    asked.metadata(case, f"{command} --only {case.number}"),
                    lambda record, watched: trial(Observer(record, watched, AFTER_FALL_S)),
                    watch,
                    asked.plant(case),
                )
                judge_in_lockstep(scenario, out)
    row = {**begin, **msgspec.structs.asdict(figures)}
    show("Measured", msgspec.structs.asdict(figures), console)
    if asked is not None and out is not None:
        console.print(f"{out}/run.mcap, run.png, summary.json", style="dim", soft_wrap=True)
    if "ending" in row:
        console.print(marked("[bold]{}[/]", row["ending"]))
    return study.exit_code(row)


def command_of(study: Study[Any], flags: Any) -> str:
    """Return the command of a study with the flags that differ from their defaults.

    Not in it: `--only`, how many cases there are, who runs them, and `--out`.
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
    """Return a flag's value as it is written."""
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
    """Print values, one a line, but for those that are None."""
    console.print(marked("[bold]{}[/]", title))
    for name, value in values.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            console.print(f"  {name:24} {text}", highlight=False)
