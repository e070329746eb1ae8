"""`xrl log resim`: reruns a log's services and compares their outputs with the log."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Final

from rich import box
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from shared import revision
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.joints import MODULES
from shared.mcap_log import provenance
from shared.toml_file import Range
from tools.flags import FINITE_MAX, Arg, Count, Run
from tools.judge.run_parts import PartFlags, part_of
from tools.lab.studies.sweeps.pool import cores, results
from tools.live.experiment import ControllerFlags
from tools.logs.reexecution.compare import ReexecutionResult, likely_reason, size
from tools.logs.reexecution.execution import RangeTask, execute_range, merged, ranges_of
from tools.logs.run_index import RunIndex
from tools.logs.run_log import has_own_controller
from tools.terminal import Console, marked

SERVICES: Final = ("planner", *MODULES)
SHOWN: Final = 12
"""Maximum number of fields listed, the largest changes first."""


EXAMPLES: Final = """
xrl log resim out/a/run.mcap
xrl log resim out/a/run.mcap --service knee_left
xrl log resim out/a/run.mcap --service planner --param law.K_p.x=2000
xrl log resim out/a/run.mcap --service planner --controller mine.py   # what would it have sent?
xrl log resim out/a/run.mcap --tolerance 1e-9             # recorded on another type of machine
"""


class ResimFlags(ControllerFlags, PartFlags):
    """Run and services to execute again, and changes."""

    log: Run
    service: Annotated[
        tuple[str, ...],
        Arg(
            choices=(*SERVICES, "all"),
            metavar="NAME",
            help="planner, a module such as knee_left, or all (default); repeatable",
        ),
    ] = ()
    param: Annotated[tuple[str, ...], Arg(metavar="NAME=VALUE")] = ()
    """change a key of the robot file, such as law.K_p.x=2000, and list the outputs that change
    most; repeatable"""
    tolerance: Annotated[float, Range(0.0, FINITE_MAX, ""), Arg(metavar="T")] = 0.0
    """maximum accepted difference between numbers (default: 0, equal to the last bit)"""
    workers: Annotated[Count, Arg(metavar="N")] = dataclasses.field(default_factory=cores)
    """processes on this machine (default: one per core)"""


def run(flags: ResimFlags) -> int:
    """Execute again, compare, and print the differences."""
    console = Console()
    index = RunIndex(flags.log)
    part = part_of(flags, index)
    chosen = set(flags.service or ("all",))
    names = SERVICES if "all" in chosen else tuple(name for name in SERVICES if name in chosen)
    task = RangeTask(index.path, part, names, flags.tolerance, flags.param, flags.controller or "")
    outcomes = _executed(ranges_of(index, task, flags.workers), flags.workers, console)
    if has_own_controller(index) and flags.controller is None and "planner" in names:
        console.print(
            "a custom controller led this run: the planner's outputs match only with --controller "
            "FILE",
            style="yellow",
        )
    console.print(summary(outcomes))
    for outcome in outcomes:
        tell(outcome, index, console, changed=task.is_changed)
    if not task.is_changed and any(outcome.differs for outcome in outcomes):
        _tell_reason(index, console)
    if not any(outcome.ticks for outcome in outcomes):
        raise RunError(
            f"{flags.log}: nothing could be executed: the log has no checkpoint or snapshot of "
            "these services; record a run of over a second with this version"
        )
    if flags.param:
        return 0
    return 0 if all(outcome.equal for outcome in outcomes if outcome.ticks) else FAULT_EXIT_CODE


def _executed(ranges: list[RangeTask], workers: int, console: Console) -> list[ReexecutionResult]:
    """Execute ranges of the run, in parallel if there are several."""
    if len(ranges) == 1:
        with Progress(console=console, transient=True) as progress:
            progress.add_task("executing again", total=None)
            return execute_range(ranges[0])
    done: dict[RangeTask, list[ReexecutionResult]] = {}
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("executing again", total=len(ranges))
        for one, outcomes in results(
            execute_range, ranges, workers, lambda one: f"from {one.part.begin_s:.0f} s"
        ):
            done[one] = outcomes
            progress.update(bar, advance=1)
    return merged([done[one] for one in ranges])


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
    """Print a service's first difference and, if the execution was changed, the largest ones."""
    first = outcome.comparison.first
    if outcome.lost_inputs:
        console.print(
            f"{outcome.service}: the log lacks {outcome.lost_inputs} messages that the service "
            "consumed; execution continued from the next checkpoint"
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
    """Print the likely reason: versions or a machine that differ from those of the run."""
    here = {
        "run": revision.code() | provenance.machine(),
        "packages": provenance.packages(),
    }
    console.print(likely_reason(index.metadata, here), style="yellow")
