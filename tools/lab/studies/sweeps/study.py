"""A study as a table, and the one runner of all of them.

The runner adds the flags that all have, draws the cases, runs those that the table lacks on this
machine or on a cluster, writes each row as it is done, and reports.
"""

from __future__ import annotations

import argparse
import hashlib
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeVar

import msgspec
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import SimTruth
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.exceptions import RunError
from shared.places import DEFAULT_CONFIG
from tools.lab.studies.sweeps import pool
from tools.lab.studies.sweeps.figures import Ending, exit_code
from tools.lab.studies.sweeps.table import CaseTable, Row, code_digest, code_of, plain
from tools.live import experiment
from tools.number_arguments import count, natural
from tools.sim.recorded_lockstep import AFTER_FALL_S, judge_in_lockstep, record_run
from tools.terminal import Console, marked
from tools.verb_table import add_config


class Numbered(Protocol):
    """A case."""

    @property
    def number(self) -> int:
        """From 0 on."""


C = TypeVar("C", bound=Numbered)

HOW_MANY: Final = ("n", "trials")
"""Flags that say how many cases there are: a case alone does without."""


class Finished(NamedTuple):
    """A study that has run, for its report."""

    args: argparse.Namespace
    robot: RobotConfig
    rows: list[Row]
    out: Path
    command: str
    """Runs one case alone, but for `--only` and its number."""
    console: Console


class CaseLog(NamedTuple, Generic[C]):
    """What the log of a case that runs alone needs."""

    scenario: Callable[[RobotConfig, C], Scenario]
    plant: Callable[[C], PlantConfig]
    metadata: Callable[[C, str], dict[str, str]]
    """By the case and its command, as for `record_run`."""


def _load(args: argparse.Namespace) -> RobotConfig:
    return experiment.load_robot(args.config)


class Study(msgspec.Struct, Generic[C], frozen=True, kw_only=True):
    """What one study has of its own."""

    name: str
    """After `xrl study sweep`."""
    case: str = "case"
    """What a case is called."""
    table: str
    """File name of the table."""
    pictures: tuple[str, ...] = ()
    code: tuple[str, ...]
    """Modules that decide how a case comes out (`code_of`)."""
    n: int = 0
    """Default of `--n`; 0: its own flags say how many cases there are."""
    only: str = ""
    """What `--only` does, for its help; empty: there is none."""
    add_flags: Callable[[argparse.ArgumentParser], None] = lambda _parser: None
    load: Callable[[argparse.Namespace], RobotConfig] = _load
    """Checks the flags and returns the robot."""
    total: Callable[[argparse.Namespace], int] = lambda args: int(args.n)
    """How many cases there are."""
    cases: Callable[[argparse.Namespace, RobotConfig], Callable[[int], C]]
    """Returns what draws the case of a number, whatever was drawn before."""
    decided_by: tuple[str, ...] = ()
    """Flags that decide the rows, beside robot and code; a folder of others is refused."""
    inputs: Callable[[argparse.Namespace], dict[str, str]] = lambda _args: {}
    """What else decides them."""
    row: Callable[[C], dict[str, object]]
    """The draws of a case by column, its number first."""
    words: Callable[[C], str] = lambda _case: ""
    """Says which case it is, where `--only` cannot."""
    figures: type[msgspec.Struct]
    """What comes of a case: the other columns."""
    trial: Callable[..., msgspec.Struct]
    """Runs a case: a function of a module, of the case, its robot, and the options."""
    options: Callable[[argparse.Namespace], dict[str, Any]] = lambda _args: {}
    robots: Callable[[Sequence[C], RobotConfig, int, Console], Sequence[RobotConfig]] = (
        lambda cases, robot, _workers, _console: [robot] * len(cases)
    )
    """The robot of each case, prepared by so many processes."""
    log: CaseLog[C] | None = None
    """None: a case alone has no log."""
    fell: Callable[[Row], bool] = lambda row: row["ending"] is not Ending.STOOD
    report: Callable[[Finished], None]
    """Prints what came of it and draws the pictures."""
    counts: Callable[[Row], bool] = lambda _row: True
    """True for a row of the study that decides its exit code."""
    exit_code: Callable[[Sequence[Row]], int] = lambda rows: exit_code(
        row["ending"] for row in rows
    )


def add_flags(parser: argparse.ArgumentParser, study: Study[Any]) -> None:
    """Add all flags of a study."""
    add_config(parser)
    if study.n:
        parser.add_argument("--n", type=count, default=study.n, help=f"{study.case}s ({study.n})")
    study.add_flags(parser)
    log = ""
    if study.only:
        parser.add_argument("--only", type=natural, metavar=study.case.upper(), help=study.only)
    if study.log is not None:
        log = f"; with --only: where the {study.case}'s log goes (default: none)"
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
        help=f"folder of {', '.join((study.table, *study.pictures))} (default: "
        f"out/sweep-{study.name}-<time>); an interrupted study resumes there{log}",
    )


def run(study: Study[C], args: argparse.Namespace) -> int:
    """Run a study, or one case of it; return the exit code.

    Raises:
        RunError: flags do not go together or make no sense, the folder holds another study, a
            case failed, or a worker was lost.
    """
    only = getattr(args, "only", None)
    if args.cluster is not None and args.workers is not None:
        raise RunError("--workers are of this machine, --cluster has its own; leave one out")
    if args.cluster is not None and only is not None:
        raise RunError("--only runs here, in one process; leave --cluster out")
    robot = study.load(args)
    case_of = study.cases(args, robot)
    console, command = Console(), command_of(study, args)
    if only is not None:
        return _run_alone(study, args, robot, case_of(only), f"{command} --only {only}", console)
    drawn = [case_of(number) for number in range(study.total(args))]
    out = args.out or Path("out") / time.strftime(f"sweep-{study.name}-%Y%m%d-%H%M%S")
    code = code_of(*study.code)
    inputs = {
        "study": study.name,
        **{name: _text(getattr(args, name)) for name in study.decided_by},
        **study.inputs(args),
        "robot": digest_of(robot),
        "code": code_digest(code),
    }
    with CaseTable(out / study.table, list(map(study.row, drawn)), study.figures, inputs) as table:
        try:
            case_s = _fill(table, study, args, robot, drawn, code, console)
        except (KeyboardInterrupt, SystemExit, RunError):
            if done := len(table.numbers):
                many = [f"--{name} {getattr(args, name)}" for name in HOW_MANY if name in args]
                many += [f"--cluster {args.cluster}"] if args.cluster else []
                again = " ".join([command, *many, f"--out {shlex.quote(str(out))}"])
                console.print(f"{done} cases are in {out}; resume with: {again}", soft_wrap=True)
            raise
        rows = table.rows
    pace = f"; {case_s:.2f} s a {study.case}" if case_s else ""
    study.report(Finished(args, robot, rows, out, command, console))
    files = ", ".join((study.table, *study.pictures))
    console.print(f"{out}/{files}{pace}", style="dim", soft_wrap=True)
    return study.exit_code([row for row in rows if study.counts(row)])


def _fill(
    table: CaseTable,
    study: Study[C],
    args: argparse.Namespace,
    robot: RobotConfig,
    drawn: Sequence[C],
    code: tuple[str, ...],
    console: Console,
) -> float:
    """Run the cases that a table lacks into it; return the wall time for each, s."""
    done, workers = table.rows, args.workers or pool.cores()
    if done:
        console.print(f"{len(done)} of {len(drawn)} cases are done already")
    missing = [case for case in drawn if case.number not in table.numbers]
    robots = study.robots(missing, robot, workers, console)
    command, fallen = command_of(study, args), sum(map(study.fell, done))
    results = pool.results(
        partial(_run_task, partial(study.trial, **study.options(args))),
        list(zip(missing, robots, strict=True)),
        pool.Cluster(args.cluster, code) if args.cluster else workers,
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
    alone = f"{command} --only {case.number}" if study.only else study.words(case)
    return f"{study.case} {case.number} ({alone})"


def _run_alone(
    study: Study[C],
    args: argparse.Namespace,
    robot: RobotConfig,
    case: C,
    command: str,
    console: Console,
) -> int:
    """Run a case, recorded and judged like a run of `xrl sim` if it is asked for."""
    begin = study.row(case)
    (robot,) = study.robots([case], robot, 1, console)
    show(f"{study.case.capitalize()} {begin['number']}, drawn", begin, console)
    trial = partial(study.trial, case, robot, **study.options(args))
    asked, out = study.log, args.out
    if asked is None:
        figures = trial()
    else:
        scenario = asked.scenario(robot, case)
        with bar("{task.completed:.1f} of {task.total:.1f} s", console) as shown:
            line = shown.add_task("", total=scenario.duration)

            def watch(truth: SimTruth) -> None:
                shown.update(line, completed=max(0.0, truth.scenario_s))

            if out is None:
                figures = trial(watch=watch)
            else:
                experiment.make_out(out, "sweep")
                figures = record_run(
                    scenario,
                    robot,
                    out,
                    asked.metadata(case, command),
                    lambda record, watched: trial(
                        record=record, watch=watched, after_fall_s=AFTER_FALL_S
                    ),
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
    return study.exit_code([row])


def command_of(study: Study[Any], args: argparse.Namespace) -> str:
    """Return the command of a study with the flags that differ from their defaults.

    Not in it: `--only`, how many cases there are, who runs them, and `--out`.
    """
    own = argparse.ArgumentParser()
    study.add_flags(own)
    words = [f"xrl study sweep {study.name} --seed {args.seed}"]
    for name, default in vars(own.parse_args([])).items():
        value, flag = getattr(args, name), f"--{name.replace('_', '-')}"
        if value == default or name in HOW_MANY:
            continue
        if value is True:
            words.append(flag)
        else:
            several = value if isinstance(value, list) else [value]
            words += [f"{flag} {shlex.quote(_text(one))}" for one in several]
    if args.config != DEFAULT_CONFIG:
        words.append(f"--config {args.config}")
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
