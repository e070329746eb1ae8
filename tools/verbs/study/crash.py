"""`xrl study crash`: one thing after the other dies on the live fleet, and the robot is judged."""

from __future__ import annotations

import difflib
import time
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Final

from rich.progress import BarColumn, Progress, TextColumn

from shared import revision
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, RunError
from shared.extras import require
from shared.mcap_log import provenance
from tools.flags import Arg, ConfigFlags, Natural
from tools.fleet import procfs
from tools.lab.studies.crash import report
from tools.lab.studies.crash.cases import CASES, CrashCase, CrashVerdict
from tools.lab.studies.crash.report import JUNIT, RESULTS, Result
from tools.lab.studies.crash.runner import run_case
from tools.lab.studies.sweeps.figures import worst
from tools.live import experiment
from tools.live.scenario_runner import LiveSnapshot
from tools.terminal import Console, marked

CASE_S: Final = 14.0
"""First estimate of a case's duration, s, until some have run."""
EXIT_CODES: Final = {
    CrashVerdict.STOOD: 0,
    CrashVerdict.SANK: FAULT_EXIT_CODE,
    CrashVerdict.FELL: FELL_EXIT_CODE,
    CrashVerdict.UNJUDGED: RunError.exit_code,
}
UNJUDGED_MAX: Final = 3
"""After this many cases in a row that cannot be judged, the machine is at fault, not the robot."""


EXAMPLES: Final = """
xrl study crash --quick
xrl study crash --out out/matrix
xrl study crash --only kill-knee_left
xrl study crash --only 'pair-*' --only 'disarmed-*'
xrl study crash --list
"""


class CrashFlags(ConfigFlags):
    """Which cases."""

    quick: bool = False
    """one case of each kind, in 5 minutes or less"""
    only: Annotated[tuple[str, ...], Arg(metavar="NAME")] = ()
    """only this case, or those that match a pattern such as 'kill-*'; may be repeated"""
    list: bool = False
    """print the cases and run none"""
    out: Annotated[
        Path | None,
        Arg(
            metavar="DIR",
            help=f"where {RESULTS}, {JUNIT} and a folder for each case go (default: "
            "out/crash-<time>); a case that did not stand keeps its run.mcap",
        ),
    ] = None
    seed: Natural = 0
    """of the sensors' noise"""


def run(flags: CrashFlags) -> int:
    """Run the matrix; 0 only if no case came out worse than it has to."""
    console = Console()
    cases = select(CASES, quick=flags.quick, only=flags.only)
    if flags.list:
        report.list_cases(cases, console)
        return 0
    require("sim")
    robot = experiment.load_robot(flags.config)
    out = _make_out(flags.out)
    for other in procfs.fleets():
        console.print(
            marked("[yellow]another fleet runs in {}: two do not fit on two cores[/]", other)
        )
    console.print(
        f"{len(cases)} cases, loop {robot.joint_service.loop!r}, about "
        f"{_minutes(len(cases) * CASE_S)}; each with a fleet of its own",
        style="dim",
        highlight=False,
    )
    results: list[Result] = []
    try:
        _run_all(cases, robot, flags.seed, out, results, console)
    except (KeyboardInterrupt, SystemExit, RunError):
        if results:
            report.show(results, console)
        console.print(f"stopped; {len(results)} of {len(cases)} cases are in {out}/{RESULTS}")
        raise
    report.show(results, console)
    console.print(f"{out}/{RESULTS}, {JUNIT}", style="dim", highlight=False, soft_wrap=True)
    return exit_code(results)


def select(cases: Sequence[CrashCase], *, quick: bool, only: Sequence[str]) -> list[CrashCase]:
    """Return the selected cases, in their order."""
    for name in only:
        if not any(fnmatchcase(case.name, name) for case in cases):
            near = difflib.get_close_matches(name, [case.name for case in cases], n=3, cutoff=0.4)
            hint = f"perhaps {', '.join(near)}; " if near else ""
            raise RunError(f"--only {name}: no such case; {hint}`xrl study crash --list` has all")
    return [
        case
        for case in cases
        if (case.quick or not quick)
        and (not only or any(fnmatchcase(case.name, name) for name in only))
    ]


def exit_code(results: Sequence[Result]) -> int:
    """Return the exit code of what came out worse than it has to."""
    return worst(EXIT_CODES[result.outcome.verdict] for result in results if not result.good)


def _run_all(
    cases: Sequence[CrashCase],
    robot: RobotConfig,
    seed: int,
    out: Path,
    results: list[Result],
    console: Console,
) -> None:
    """Run the cases, each written as it is done."""
    about = _about(robot)
    bar = Progress(
        BarColumn(bar_width=20),
        TextColumn("{task.completed}/{task.total}  {task.fields[left]} left"),
        TextColumn("{task.fields[case]}  {task.fields[now]}"),
        console=console,
        transient=True,
    )
    with bar:
        shown = bar.add_task("", total=len(cases), case="", left="", now="")

        def show(snapshot: LiveSnapshot) -> None:
            if snapshot.truth is not None:
                now_s, modes = max(0.0, snapshot.truth.scenario_s), "".join(snapshot.modes)
                height = snapshot.truth.torso[2]
                bar.update(shown, now=f"{now_s:4.1f} s {height:.2f} m {modes}")

        for number, case in enumerate(cases):
            left = _minutes(_left_s(results, len(cases) - number))
            bar.update(shown, case=case.name, left=left, now="starting")
            outcome = run_case(case, robot, out / case.name, show, seed=seed)
            results.append(Result(case, outcome))
            report.write(results, out, about, planned=len(cases))
            bar.update(shown, advance=1)
            left = _minutes(_left_s(results, len(cases) - number - 1))
            place = marked("[dim]{}/{}, {} left[/]", number + 1, len(cases), left)
            bar.console.print(report.line_of(results[-1]), place, highlight=False, soft_wrap=True)
            last = [result.outcome.verdict for result in results[-UNJUDGED_MAX:]]
            if last == [CrashVerdict.UNJUDGED] * UNJUDGED_MAX:
                reason = outcome.remarks[0]
                raise RunError(f"{UNJUDGED_MAX} cases in a row cannot be judged: {reason}")


def _left_s(results: Sequence[Result], cases: int) -> float:
    """Return how long so many cases take, by those that are done, s."""
    done = [result.outcome.wall_s for result in results]
    return cases * (sum(done) / len(done) if done else CASE_S)


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90.0 else f"{seconds:.0f} s"


def _about(robot: RobotConfig) -> dict[str, str]:
    """Return the origin of the results: robot, code, machine."""
    run = {
        "robot": robot.name,
        "loop": robot.joint_service.loop,
        "driver": robot.joint_service.driver,
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    return run | revision.code() | provenance.machine()


def _make_out(out: Path | None) -> Path:
    """Make the folder of the results, unless it holds some already."""
    if out is not None and (out / RESULTS).exists():
        raise RunError(f"{out}: holds results already; choose another --out, or remove it")
    return experiment.make_out(out, "crash")
