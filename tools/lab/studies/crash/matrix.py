"""`xrl study crash`: one thing after the other dies on the live fleet, and the robot is judged."""

from __future__ import annotations

import difflib
import time
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Final

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, RunError
from shared.extras import require
from tools.flags import Arg, ConfigFlags, Natural
from tools.fleet.status_table import warn_of_others
from tools.lab.studies.crash.cases import CASES, CrashCase, CrashVerdict, describe
from tools.lab.studies.crash.outcome import CrashResult, run_case
from tools.lab.studies.sweeps import pool
from tools.lab.studies.sweeps.figures import worst
from tools.lab.studies.sweeps.study import digest_of
from tools.lab.studies.sweeps.table import CaseTable, Row
from tools.live import experiment
from tools.live.scenario_runner import LiveSnapshot
from tools.terminal import Console, marked

TABLE: Final = "cases.csv"
CASE_S: Final = 14.0
"""Duration of a case, start and stop of its fleet included, s."""
UNJUDGED_MAX: Final = 3
"""After this many cases in a row that cannot be judged, the machine is at fault, not the robot."""
EXIT_CODES: Final = {
    CrashVerdict.STOOD: 0,
    CrashVerdict.SANK: FAULT_EXIT_CODE,
    CrashVerdict.FELL: FELL_EXIT_CODE,
    CrashVerdict.UNJUDGED: RunError.exit_code,
}
COLOURS: Final = {
    CrashVerdict.STOOD: "green",
    CrashVerdict.SANK: "yellow",
    CrashVerdict.FELL: "red",
    CrashVerdict.UNJUDGED: "magenta",
}
COLUMNS: Final = (
    ("fell", "fell_after_s", ".2f"),
    ("safe", "safe_ms", ".0f"),
    ("step", "torque_step_nm", ".2f"),
    ("back", "torque_step_back_nm", ".2f"),
    ("leads", "leads_again_s", ".2f"),
    ("x", "com_x_mm", "+.0f"),
    ("y", "com_y_mm", "+.0f"),
)
"""Heading, figure, format."""
LEGEND: Final = (
    "may: what is allowed, if not to stand only; fell: s from the crash; safe: ms from it to "
    "HOLD, slowest of the modules not hit; step: N m, largest of their torques then; back: N m, "
    "largest of any module after the request; leads: s from the restart to the last TRACK; "
    "x, y: mm, COM farthest from the middle after the crash"
)

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
            help=f"folder of {TABLE} and of each case (default: out/crash-<time>); an interrupted "
            "matrix resumes there, and a case that did not stand keeps its run.mcap",
        ),
    ] = None
    seed: Natural = 0
    """of the sensors' noise"""


def run(flags: CrashFlags) -> int:
    """Run the matrix; 0 only if no case came out worse than it may."""
    console = Console()
    cases = select(CASES, quick=flags.quick, only=flags.only)
    if flags.list:
        _print_cases(cases, console)
        return 0
    require("sim")
    robot = experiment.load_robot(flags.config)
    out = flags.out or Path("out") / time.strftime("crash-%Y%m%d-%H%M%S")
    warn_of_others(console)
    inputs = {"study": "crash", "seed": str(flags.seed), "robot": digest_of(robot),
              "code": pool.code_digest()}  # fmt: skip
    with CaseTable(out / TABLE, list(map(row_of, cases)), CrashResult, inputs) as table:
        try:
            _fill(table, cases, robot, flags.seed, out, console)
        except (KeyboardInterrupt, SystemExit, RunError):
            show(table.rows, console)
            console.print(f"stopped; {len(table.rows)} of {len(cases)} cases are in {out}/{TABLE}")
            raise
        rows = table.rows
    show(rows, console)
    console.print(f"{out}/{TABLE}", style="dim", highlight=False, soft_wrap=True)
    return exit_code(rows)


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


def row_of(case: CrashCase) -> dict[str, object]:
    """Return a case by its columns."""
    return {
        "number": CASES.index(case),
        "name": case.name,
        "what": describe(case),
        "expected": case.expected,
    }


def is_good(row: Row) -> bool:
    """Return True if the robot came out of a case no worse than it may."""
    return CrashVerdict(row["verdict"]).badness <= CrashVerdict(row["expected"]).badness


def exit_code(rows: Sequence[Row]) -> int:
    """Return the exit code of what came out worse than it may."""
    return worst(EXIT_CODES[row["verdict"]] for row in rows if not is_good(row))


def _fill(
    table: CaseTable,
    cases: Sequence[CrashCase],
    robot: RobotConfig,
    seed: int,
    out: Path,
    console: Console,
) -> None:
    """Run the cases that the table lacks, each written as it is done."""
    bar = Progress(
        BarColumn(bar_width=20), TextColumn("{task.completed}/{task.total}"),
        TimeRemainingColumn(), TextColumn("{task.fields[case]}  {task.fields[now]}"),
        console=console, transient=True,
    )  # fmt: skip
    unjudged = 0
    with bar:
        shown = bar.add_task("", total=len(cases), case="", now="")

        def see(snapshot: LiveSnapshot) -> None:
            if snapshot.truth is not None:
                now_s, modes = max(0.0, snapshot.truth.scenario_s), "".join(snapshot.modes)
                bar.update(shown, now=f"{now_s:4.1f} s {snapshot.truth.torso[2]:.2f} m {modes}")

        for case in cases:
            row = row_of(case)
            if row["number"] not in table.numbers:
                bar.update(shown, case=case.name, now="starting")
                done = table.add(row, run_case(case, robot, out / case.name, see, seed=seed))
                bar.console.print(_line_of(done), highlight=False, soft_wrap=True)
                unjudged = unjudged + 1 if done["verdict"] == CrashVerdict.UNJUDGED else 0
                if unjudged == UNJUDGED_MAX:
                    reason = done["remarks"]
                    raise RunError(f"{UNJUDGED_MAX} cases in a row cannot be judged: {reason}")
            bar.update(shown, advance=1)


def _print_cases(cases: Sequence[CrashCase], console: Console) -> None:
    table = Table(title=f"{len(cases)} cases", title_justify="left")
    table.add_column("name", no_wrap=True)
    table.add_column("at worst")
    table.add_column("why", overflow="fold")
    for case in cases:
        name = marked("{} [dim](quick)[/]", case.name) if case.quick else case.name
        table.add_row(name, Text(case.expected, COLOURS[case.expected]), case.why)
    console.print(table)


def _line_of(row: Row) -> Text:
    """Return a result in one line."""
    words = [marked("{} {}", Text(f"{row['verdict'].upper():8}", COLOURS[row["verdict"]]),
                    row["name"])]  # fmt: skip
    if not is_good(row):
        words.append(marked("[bold red]expected at worst: {}[/]", row["expected"]))
    if row["remarks"]:
        words.append(Text(row["remarks"], "yellow"))
    return Text(", ").join(words)


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the verdict table and the sentence under it."""
    table = Table(title="Verdict", title_justify="left", box=None, padding=(0, 1, 0, 0))
    for heading in ("case", "verdict", "may", *(heading for heading, _, _ in COLUMNS)):
        is_text = heading in ("case", "verdict", "may")
        table.add_column(heading, justify="left" if is_text else "right", no_wrap=True)
    for row in rows:
        may = "" if row["expected"] == CrashVerdict.STOOD else str(row["expected"])
        figures = [(row[name], form) for _, name, form in COLUMNS]
        cells = ("" if value is None else f"{value:{form}}" for value, form in figures)
        verdict = Text(row["verdict"], COLOURS[row["verdict"]])
        table.add_row(row["name"], verdict, may, *cells)
    console.print(table)
    console.print(LEGEND, style="dim", highlight=False)
    for row in rows:
        if row["remarks"] or not is_good(row):
            console.print(_line_of(row), highlight=False)
    good = sum(map(is_good, rows))
    verdicts = [row["verdict"] for row in rows]
    counts = ", ".join(f"{verdicts.count(one)} {one}" for one in CrashVerdict if one in verdicts)
    colour = "green" if good == len(rows) else "red"
    text = f"[bold {colour}]{{}} of {{}} as expected or better[/]: {{}}"
    console.print(marked(text, good, len(rows), counts), highlight=False)
