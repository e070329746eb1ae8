"""`xrl sweep kill`: the planner killed at random, in random postures and under pushes."""

from __future__ import annotations

import argparse
import hashlib
import time
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from shared import config
from shared.config import RobotConfig
from shared.exceptions import RunError
from shared.messages import SimTruth
from shared.process import DEFAULT_CONFIG
from tools.runs import experiment
from tools.sweeps import cases, picture, pool, report
from tools.sweeps.cases import Case
from tools.sweeps.outcome import Outcome, run_case
from tools.sweeps.prepare import needs_schedule, prepare
from tools.sweeps.record import record_case
from tools.sweeps.table import Table, code_digest
from tools.verbs import add_config

N: Final = 500
TABLE: Final = "cases.csv"
PICTURE: Final = "cases.png"
CODE: Final = (
    "services", "shared", "tools/runs/lockstep.py", "tools/runs/network.py",
    "tools/runs/virtual_harness.py", "tools/sweeps/cases.py", "tools/sweeps/outcome.py",
)  # fmt: skip
"""What decides how a case comes out."""
COLUMNS_OUT: Final = Outcome.__struct_fields__

EXAMPLES: Final = """
    xrl sweep kill
    xrl sweep kill --n 500 --seed 1 --out out/kill
    xrl sweep kill --only 137 --seed 1
    xrl sweep kill --only 137 --seed 1 --out out/case137
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument("--n", type=int, default=N, help=f"cases ({N})")
    parser.add_argument("--seed", type=int, default=1, help="of the cases (1)")
    parser.add_argument(
        "--workers", type=int, default=pool.cores(), help=f"processes (one a core: {pool.cores()})"
    )
    parser.add_argument(
        "--split", choices=experiment.choices("split"), help="gain split of the law"
    )
    parser.add_argument(
        "--jacobian", choices=experiment.choices("jacobian"), help="how the legs share the load"
    )
    parser.add_argument(
        "--only", type=int, metavar="CASE", help="run this case alone and print all of it"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"where {TABLE} and {PICTURE} go (default: out/sweep-kill-<time>); a study that was "
        "stopped is gone on with; with --only: where the case's log goes (default: none)",
    )


def run(args: argparse.Namespace) -> int:
    """Run the study, or one case of it; 1 if any fell."""
    for flag, value, least in (
        ("--n", args.n, 1), ("--workers", args.workers, 1), ("--only", args.only or 0, 0),
    ):  # fmt: skip
        if value < least:
            raise RunError(f"{flag} {value}: must be at least {least}")
    robot = experiment.make_robot(args)
    console = Console()
    return (
        _run_one(args, robot, console) if args.only is not None else _run_all(args, robot, console)
    )


def _run_all(args: argparse.Namespace, robot: RobotConfig, console: Console) -> int:
    out = args.out or Path("out") / time.strftime("sweep-kill-%Y%m%d-%H%M%S")
    drawn = [cases.draw(robot, args.seed, number) for number in range(args.n)]
    columns = [*cases.row_of(drawn[0]), *COLUMNS_OUT]
    with Table(out, TABLE, columns, _inputs(args.seed, robot)) as table:
        missing = [case for case in drawn if case.number not in table.numbers]
        if len(missing) < args.n:
            console.print(f"{args.n - len(missing)} of {args.n} cases are done already")
        try:
            seconds = _run_missing(missing, robot, table, args.workers, console)
        except (KeyboardInterrupt, SystemExit):
            done = len(table.rows(args.n))
            again = f"{_command(args)} --n {args.n} --out {out}"
            console.print(f"{done} cases are in {out / TABLE}; go on with: {again}", soft_wrap=True)
            raise
    rows = table.rows(args.n)
    fallen = report.falls(rows)
    title = f"Planner killed, {len(rows)} random cases, seed {args.seed}: {len(fallen)} fell"
    picture.draw(rows, robot, title, out / PICTURE)
    report.show(rows, _command(args), console)
    pace = f"; {seconds:.2f} s a case" if missing else ""
    console.print(f"{out / TABLE}, {PICTURE}{pace}", style="dim", soft_wrap=True)
    return 1 if fallen else 0


def _run_missing(
    missing: list[Case], robot: RobotConfig, table: Table, workers: int, console: Console
) -> float:
    """Run cases into the table; return the wall time for each, s."""
    robots = _robots({case.payload_kg for case in missing}, robot, workers, console)
    tasks = [(case, robots[case.payload_kg]) for case in missing]
    begin = time.monotonic()
    fallen = 0
    with _bar("{task.completed} of {task.total} cases, {task.fields[fallen]} fell", console) as bar:
        shown = bar.add_task("", total=len(tasks), fallen=0)
        for (case, _), outcome in pool.results(_run_task, tasks, workers, _name):
            table.add(cases.row_of(case) | _figures(outcome))
            fallen += not outcome.stood
            bar.update(shown, advance=1, fallen=fallen)
    return (time.monotonic() - begin) / max(1, len(tasks))


def _robots(
    payloads: set[float], robot: RobotConfig, workers: int, console: Console
) -> dict[float, RobotConfig]:
    """Return the robot with each payload, ready to run."""
    ordered = sorted(payloads)
    loaded = [cases.with_payload(robot, payload) for payload in ordered]
    if not any(needs_schedule(one) for one in loaded):
        return dict(zip(ordered, loaded, strict=True))
    with _bar("{task.completed} of {task.total} gain schedules", console) as bar:
        shown = bar.add_task("", total=None)
        ready = prepare(
            loaded, workers, lambda done, of: bar.update(shown, completed=done, total=of)
        )
    return dict(zip(ordered, ready, strict=True))


def _run_one(args: argparse.Namespace, robot: RobotConfig, console: Console) -> int:
    case = cases.draw(robot, args.seed, args.only)
    loaded = _robots({case.payload_kg}, robot, 1, console)[case.payload_kg]
    _print(f"Case {case.number}, drawn", cases.row_of(case), console)
    command = f"{_command(args)} --only {case.number}"
    with _bar("{task.completed:.1f} of {task.total:.1f} s", console) as bar:
        shown = bar.add_task("", total=case.end_s)

        def watch(truth: SimTruth) -> None:
            bar.update(shown, completed=max(0.0, truth.scenario_s))

        if args.out is None:
            outcome = run_case(case, loaded, watch=watch)
        else:
            out = experiment.make_out(args.out, "sweep-kill")
            outcome, _ = record_case(case, loaded, out, command, watch)
    _print("Measured", _figures(outcome), console)
    if args.out is not None:
        console.print(f"{args.out}/run.mcap, run.png, summary.json", style="dim", soft_wrap=True)
    console.print(f"[bold]{outcome.ending}[/]")
    return 0 if outcome.stood else 1


def _run_task(task: tuple[Case, RobotConfig]) -> Outcome:
    case, robot = task
    return run_case(case, robot)


def _name(task: tuple[Case, RobotConfig]) -> str:
    return f"case {task[0].number} (xrl sweep kill --seed {task[0].seed} --only {task[0].number})"


def _figures(outcome: Outcome) -> dict[str, object]:
    return {name: getattr(outcome, name) for name in COLUMNS_OUT}


def _print(title: str, row: dict[str, object], console: Console) -> None:
    console.print(f"[bold]{title}[/]")
    for name, value in row.items():
        if value is not None:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            console.print(f"  {name:24} {text}", highlight=False)


def _bar(text: str, console: Console) -> Progress:
    return Progress(
        BarColumn(), TextColumn(text), TimeRemainingColumn(), console=console, transient=True
    )


def _inputs(seed: int, robot: RobotConfig) -> dict[str, str]:
    digest = hashlib.sha256(config.to_toml(robot).encode()).hexdigest()
    return {"study": "kill", "seed": str(seed), "robot": digest, "code": code_digest(CODE)}


def _command(args: argparse.Namespace) -> str:
    """Return the command of this study, but for --n, --only and --out."""
    flags = [f"--seed {args.seed}"]
    if args.config != DEFAULT_CONFIG:
        flags.append(f"--config {args.config}")
    flags += [
        f"--{name} {getattr(args, name)}" for name in ("split", "jacobian") if getattr(args, name)
    ]
    return " ".join(["xrl sweep kill", *flags])
