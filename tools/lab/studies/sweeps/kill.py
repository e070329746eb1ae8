"""`xrl study sweep kill`: the planner killed at random, in random postures and under pushes."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Final, TypeAlias

import msgspec

from shared.config.robot_config import RobotConfig
from tools.lab.studies.sweeps import cases, picture, plants, push_range, report, study
from tools.lab.studies.sweeps.figures import ENDINGS, Ending, exit_code
from tools.lab.studies.sweeps.outcome import KillResult, plant_of, run_case
from tools.lab.studies.sweeps.prepare import needs_schedule, prepare
from tools.lab.studies.sweeps.record import run_alone
from tools.lab.studies.sweeps.table import code_of
from tools.live import experiment
from tools.number_arguments import count, natural
from tools.terminal import Console
from tools.verb_table import add_config

N: Final = 500
TABLE: Final = "cases.csv"
PICTURE: Final = "cases.png"
CODE: Final = code_of("tools.lab.studies.sweeps.outcome", "tools.lab.studies.sweeps.prepare")
"""What decides how a case comes out."""
COLUMNS_OUT: Final = KillResult.__struct_fields__
LABELS: Final = {"ending": ENDINGS}
Task: TypeAlias = "tuple[cases.KillCase, RobotConfig]"

EXAMPLES: Final = """
    xrl study sweep kill
    xrl study sweep kill --n 500 --seed 1 --out out/kill
    xrl study sweep kill --only 137 --seed 1
    xrl study sweep kill --only 137 --seed 1 --out out/case137
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument("--n", type=count, default=N, help=f"cases ({N})")
    parser.add_argument(
        "--split", choices=experiment.choices("split"), help="gain split of the law"
    )
    parser.add_argument(
        "--jacobian", choices=experiment.choices("jacobian"), help="how the legs share the load"
    )
    push_range.add_flag(parser)
    experiment.add_imu(parser)
    parser.add_argument(
        "--only",
        type=natural,
        metavar="CASE",
        help="run this case alone and print all of it; exit code 1 if it fell",
    )
    alone = "; with --only: where the case's log goes (default: none)"
    study.add_flags(parser, "kill", f"{TABLE} and {PICTURE}", alone)


def run(args: argparse.Namespace) -> int:
    """Run the study, or one case of it; 0 if none fell."""
    push_range.check(args)
    executor = study.executor_of(args, CODE)
    robot = experiment.make_robot(args)
    console = Console()
    if args.only is not None:
        return _run_one(args, robot, console)
    return _run_all(args, robot, executor, console)


def _run_all(
    args: argparse.Namespace, robot: RobotConfig, executor: study.Executor, console: Console
) -> int:
    study_of = cases.KillCases(robot, args.push)
    drawn = [study_of.draw(args.seed, number) for number in range(args.n)]
    rows_begin = [cases.row_of(case) for case in drawn]
    columns = [*rows_begin[0], *COLUMNS_OUT]

    def tasks(done: set[int]) -> list[Task]:
        missing = [case for case in drawn if case.number not in done]
        robots = _robots({case.payload_kg for case in missing}, robot, executor.workers, console)
        return [(case, robots[case.payload_kg]) for case in missing]

    inputs = study.inputs(
        "kill", robot, CODE, seed=str(args.seed), push=f"{args.push:g}", ranges=plants.digest()
    )
    finished = study.run(
        study.Study(
            "kill", TABLE, columns, LABELS, inputs, rows_begin, args.n, JOB,
            f"{_command(args)} --n {args.n}",
        ),
        tasks, args.out, executor, console,
    )  # fmt: skip
    rows = finished.rows
    fallen = report.falls(rows)
    title = f"Planner killed, {len(rows)} random cases, seed {args.seed}, "
    title += f"{push_range.describe(args)}: {len(fallen)} fell"
    picture.draw(rows, robot, title, finished.out / PICTURE)
    report.show(rows, _command(args), console)
    finished.show_files(f"{TABLE}, {PICTURE}", "case", console)
    return exit_code(row["ending"] for row in rows)


def _robots(
    payloads: set[float], robot: RobotConfig, workers: int, console: Console
) -> dict[float, RobotConfig]:
    """Return the robot with each payload, ready to run."""
    ordered = sorted(payloads)
    loaded = [cases.with_payload(robot, payload) for payload in ordered]
    if not any(needs_schedule(one) for one in loaded):
        return dict(zip(ordered, loaded, strict=True))
    with study.bar("{task.completed} of {task.total} gain schedules", console) as bar:
        shown = bar.add_task("", total=None)
        ready = prepare(
            loaded, workers, lambda done, of: bar.update(shown, completed=done, total=of)
        )
    return dict(zip(ordered, ready, strict=True))


def _run_one(args: argparse.Namespace, robot: RobotConfig, console: Console) -> int:
    case = cases.KillCases(robot, args.push).draw(args.seed, args.only)
    loaded = _robots({case.payload_kg}, robot, 1, console)[case.payload_kg]
    study.show(f"Case {case.number}, drawn", cases.row_of(case), console)
    words = f"{_command(args)} --only {case.number}; delay {case.delay_ms:g} ms, " + (
        "hand on" if case.let_go_s is None else f"hand off at {case.let_go_s:g} s"
    )
    return run_alone(
        partial(run_case, case, loaded),
        cases.scenario_of(loaded, case),
        loaded,
        args.out,
        {"lockstep": words},
        console,
        plant_of(case),
    )


def _run_task(task: Task) -> KillResult:
    case, robot = task
    return run_case(case, robot)


def _name(task: Task) -> str:
    case = task[0]
    return f"case {case.number} (xrl study sweep kill --seed {case.seed} --only {case.number})"


def _rows(task: Task, outcome: KillResult) -> list[dict[str, object]]:
    return [cases.row_of(task[0]) | msgspec.structs.asdict(outcome)]


JOB: Final = study.Job(_run_task, _name, _rows, lambda row: row["ending"] != Ending.STOOD)


def _command(args: argparse.Namespace) -> str:
    """Return the command of this study, but for --n, --only and --out."""
    flags = [f"--seed {args.seed}", *push_range.flags(args)]
    flags += [
        f"--{name} {getattr(args, name)}" for name in ("split", "jacobian") if getattr(args, name)
    ]
    return study.command("kill", args, *flags, *(["--imu"] if args.imu else []))
