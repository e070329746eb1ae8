"""`xrl resim`: runs a log's services again and compares their outputs with the recorded ones."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rich import box
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from services.planner.controller_file import controller_maker
from shared import revision
from shared.bus.messages import Message
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.joints import MODULES
from shared.mcap_log import provenance
from tools.judge.run_parts import add_part, part_of
from tools.lab.studies.sweeps.pool import cores, results
from tools.live import experiment
from tools.logs.reexecution import rewritten
from tools.logs.reexecution.compare import likely_reason, size
from tools.logs.reexecution.execution import Execution
from tools.logs.reexecution.outcome import ReexecutionResult
from tools.logs.reexecution.params import with_params
from tools.logs.reexecution.ranges import RangeTask, execute_range, merged, ranges_of
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, has_own_controller, parts_of, read_part, robot_of
from tools.number_arguments import count, finite
from tools.terminal import Console, marked
from tools.verb_table import RUN_HELP, Subparsers, add_verb

SERVICES: Final = ("planner", *MODULES)
SHOWN: Final = 12
"""Fields that are listed, those that change most first."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "resim",
        """
        xrl resim out/a/run.mcap                              # planner and six services
        xrl resim out/a/run.mcap --service knee_left --until-first-difference
        xrl resim out/a/run.mcap --service planner --param law.K_p.x=2000
        xrl resim out/a/run.mcap --service planner --controller mine.py   # what would it have sent?
        xrl resim out/a/run.mcap --tolerance 1e-9             # of another machine class
        xrl resim out/a                                       # a split run, all of its files
        xrl resim out/a --from 1200 --to 1260                 # a minute of a long one
        """,
    )
    parser.add_argument("log", type=Path, metavar="RUN", help=RUN_HELP)
    parser.add_argument(
        "--service",
        action="append",
        choices=(*SERVICES, "all"),
        metavar="NAME",
        help=f"all (default), or one of {', '.join(SERVICES)}; may be given several times",
    )
    parser.add_argument(
        "--param",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a key of the robot file with another value, such as law.K_p.x=2000 or "
        "joint_service.blend_ms=100: the same inputs, and what would have come out; a new file "
        "is written beside the old",
    )
    experiment.add_controller(parser)
    add_part(parser)
    parser.add_argument(
        "--until-first-difference", action="store_true", help="stop there; sooner done"
    )
    parser.add_argument(
        "--tolerance",
        type=finite,
        default=0.0,
        metavar="T",
        help="largest accepted difference of numbers (default 0: equal to the last bit)",
    )
    parser.add_argument(
        "--workers",
        type=count,
        default=cores(),
        metavar="N",
        help="processes for a run of over a minute (default: one for each core)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="with --param: the new file (default: RUN.resim.mcap beside the old)",
    )


def run(args: argparse.Namespace) -> int:
    """Execute, compare, tell."""
    if not args.tolerance >= 0.0:
        raise RunError(f"--tolerance {args.tolerance:g}: zero or more is right")
    console = Console()
    index = RunIndex(args.log)
    part = part_of(args, index)
    chosen = set(args.service or ("all",))
    names = SERVICES if "all" in chosen else tuple(name for name in SERVICES if name in chosen)
    path = args.out or index.files[0].with_suffix(".resim.mcap")
    if args.param and path.exists():
        raise RunError(f"{path}: is there already; remove it, or name another with --out")
    recomputed = dict[str, list[Message]]()
    # a new file, a controller's memory and a first difference need one part after the other
    one_by_one = args.param or args.controller or args.until_first_difference
    whole: RunLog | None = None
    with Progress(console=console, transient=True) as progress:
        ranges = (
            []
            if one_by_one
            else ranges_of(index, part, names, args.tolerance, workers=args.workers)
        )
        if len(ranges) > 1 and args.workers > 1:
            outcomes = _side_by_side(ranges, args.workers, progress)
        else:
            # the new file is written from all of the old: that is read at once
            whole = read_part(index, part, as_sent=True) if args.param else None
            logs = parts_of(index, part, as_sent=True) if whole is None else iter((whole,))
            outcomes = _one_by_one(
                args, logs, min(part.end_s, index.length_s), names, recomputed, progress
            )
    if has_own_controller(index) and args.controller is None and "planner" in names:
        console.print(
            "a controller of somebody's own led: the planner is equal only with --controller FILE",
            style="yellow",
        )
    console.print(summary(outcomes))
    changed = bool(args.param or args.controller)
    for outcome in outcomes:
        tell(outcome, index, console, changed=changed)
    if not changed and any(outcome.comparison.first for outcome in outcomes):
        _tell_reason(index, console)
    if not any(outcome.ticks for outcome in outcomes):
        raise RunError(
            f"{args.log}: nothing could be executed: it holds no memory of these services; a "
            "run that was recorded by this version for more than a second does"
        )
    if whole is not None:
        number = rewritten.write(whole, path, recomputed, {"params": ", ".join(args.param)})
        console.print(f"{number} messages, the recomputed ones among them, in {path}")
        return 0
    return 0 if all(outcome.equal for outcome in outcomes if outcome.ticks) else FAULT_EXIT_CODE


def _side_by_side(
    ranges: list[RangeTask], workers: int, progress: Progress
) -> list[ReexecutionResult]:
    """Execute ranges of the run in worker processes."""
    task = progress.add_task("executing again", total=len(ranges))
    done: dict[RangeTask, list[ReexecutionResult]] = {}
    for one, results_of_range in results(
        execute_range, ranges, workers, lambda one: f"from {one.part.begin_s:.0f} s"
    ):
        done[one] = results_of_range
        progress.update(task, advance=1, description=f"executed from {one.part.begin_s:.0f} s")
    return merged([done[one] for one in ranges])


def _one_by_one(
    args: argparse.Namespace,
    logs: Iterator[RunLog],
    end_s: float,
    names: tuple[str, ...],
    recomputed: dict[str, list[Message]],
    progress: Progress,
) -> list[ReexecutionResult]:
    """Execute a run's services part by part, here.

    Args:
        args: of the command line.
        logs: the run, or its parts one after the other.
        end_s: where they end, s since the run's first message.
        names: of the services.
        recomputed: is given what came out, by key, if a parameter is changed.
        progress: is given the time.
    """
    executions: list[Execution] = []
    task = progress.add_task("executing again", total=None)
    for log in logs:
        if not executions:
            robot = with_params(robot_of(log), args.param, str(args.log))
            make = controller_maker(args.controller, robot) if args.controller else None
            exact = not (args.param or args.controller)
            executions = [
                Execution(robot, name, args.tolerance, exact=exact, controller=make)
                for name in names
            ]
        for number, execution in enumerate(executions):
            if args.until_first_difference and execution.differs:
                continue
            done_s = number / len(executions) * (log.end_ns - log.begin_ns) / 1e9
            progress.update(
                task,
                description=f"executing {execution.outcome.service}",
                completed=(log.begin_ns - log.began_ns()) / 1e9 + done_s,
                total=end_s,
            )
            for key, message in execution.run(log):
                if args.param:
                    recomputed.setdefault(key, []).append(message)
                if args.until_first_difference and execution.differs:
                    break
        if args.until_first_difference and all(one.differs for one in executions):
            break
    return [execution.outcome for execution in executions]


def summary(outcomes: list[ReexecutionResult]) -> Table:
    """Return the counts as a table."""
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("service", "ticks", "not executed", "messages compared", "result"):
        table.add_column(heading, justify="left" if heading in ("service", "result") else "right")
    for outcome in outcomes:
        comparison = outcome.comparison
        if not outcome.ticks:
            result = Text("nothing executed", "yellow")
        elif comparison.first is None:
            result = Text(f"{outcome.ticks} ticks, all equal")
        else:
            result = Text(f"{comparison.differing} differ", "bold red")
        table.add_row(
            outcome.service,
            str(outcome.ticks),
            str(outcome.skipped),
            str(comparison.compared),
            result,
        )
    return table


def tell(outcome: ReexecutionResult, index: RunIndex, console: Console, *, changed: bool) -> None:
    """Print the first difference of a service, and with a changed parameter the largest."""
    first = outcome.comparison.first
    if outcome.lost_inputs:
        console.print(
            f"{outcome.service}: the log lacks {outcome.lost_inputs} messages that it took; "
            "execution went on from the next memory"
        )
    if first is None:
        return
    began_ns = index.began_ns - index.offset_ns
    at_s = (first.t_ns - began_ns) / 1e9
    console.print(
        marked("[bold]{}[/], first at {:.3f} s: {}", outcome.service, at_s, first.describe())
    )
    if not changed:
        return
    table = Table(title="largest changes", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("topic", "field", "at s", "recorded", "recomputed"):
        table.add_column(heading, justify="left" if heading in ("topic", "field") else "right")
    rows = sorted(outcome.comparison.largest.values(), key=size, reverse=True)
    for row in rows[:SHOWN]:
        seconds = (row.t_ns - began_ns) / 1e9
        recorded, recomputed = (_short(value) for value in (row.recorded, row.recomputed))
        table.add_row(row.key, row.field, f"{seconds:.3f}", recorded, recomputed)
    console.print(table)


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)[:24]


def _tell_reason(index: RunIndex, console: Console) -> None:
    """Print what the run was made with that is something else here."""
    here = {
        "run": revision.code() | provenance.machine(),
        "packages": provenance.packages(),
    }
    console.print(likely_reason(index.metadata, here), style="yellow")
