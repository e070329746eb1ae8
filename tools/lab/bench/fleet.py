"""`xrl bench fleet`: the whole fleet, led live; one revision beside another.

Its record tells what it costs and achieves.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from rich.text import Text

from shared.bus import topics
from shared.bus.messages import JointCommand
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_MS
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.extras import require
from shared.joints import MODULES
from shared.places import CHECKOUT
from shared.toml_file import Range
from tools.flags import Arg
from tools.fleet.pace import PACE_MIN
from tools.fleet.status_table import warn_of_others
from tools.judge.verdict_table import digits
from tools.lab.bench.revisions import environment, its_config, unpacked
from tools.lab.bench.table import (
    AgainstFlags,
    Row,
    compared,
    print_table,
    ratio_cell,
    write_rows,
)
from tools.logs.run_log import RunLog, read_run
from tools.terminal import Console

Array = NDArray[np.float64]

ROUNDS: Final = 3
PATIENCE_S: Final = 600.0
"""A run that has not ended by then is ended."""
ENDING_S: Final = 30.0
"""Time for an interrupted run to end its fleet."""

FIRST_USE: Final = "first_use_ms"
"""Ages of commands, which this bench reads from the record."""
LAST_LINES: Final = 3
"""Lines of a failed run's output that the error quotes."""

Turn: TypeAlias = dict[str, float | None]
"""A run's figures by name; None: its record has no such."""


class Figure(NamedTuple):
    """One figure of a run."""

    name: str
    """Name of it in a `Turn`."""
    what: str
    unit: str
    most: float | None
    """Target of docs/results.md#targets at pace 1; None: none."""
    path: tuple[str, ...]
    """Where it stands in the run's summary, or below `FIRST_USE`."""


FIGURES: Final = (
    Figure("tick_us", "tick, median", "us", 300.0, ("planner_tick_us", "median")),
    Figure("tick_p99_us", "tick, p99", "us", None, ("planner_tick_us", "p99")),
    Figure("cpu_pct", "CPU, all processes", "%", 110.0, ("fleet_cpu_pct",)),
    Figure("late_pct", "PD cycles late", "%", 0.5, ("pd_cycles_late_pct",)),
    Figure("first_use_ms", "age at first use, median", "ms", None, (FIRST_USE, "median")),
    Figure("first_use_p99_ms", "age at first use, p99", "ms", 3.0, (FIRST_USE, "p99")),
    Figure("hand_n", "hand's peak", "N", 40.0, ("operator_peak_n",)),
    Figure("com_x_mm", "COM x, led", "mm", 20.0, ("alive_com_x_max_mm",)),
)


def measure(tree: Path, config: Path, scenario: str, pace: float) -> Turn:
    """Lead a tree's fleet through a scenario, live; this tree reads its record.

    Raises:
        RunError: the robot fell, or there was no run.
    """
    with tempfile.TemporaryDirectory(prefix="xrl-fleet-") as folder:
        out = Path(folder) / "run"
        words = ("--config", str(config), "--scenario", scenario, "--pace", f"{pace:g}")
        code, said = _lead(tree, [*words, "--out", str(out)])
        if code:
            last = said.strip().splitlines()[-LAST_LINES:] or ["it said nothing"]
            raise RunError(f"{tree}: `xrl demo` ended with {code}: {' / '.join(last)}")
        summary = msgspec.json.decode((out / "summary.json").read_bytes())
        return figures(summary, first_use_ms(read_run(out)))


def _lead(tree: Path, words: Sequence[str]) -> tuple[int, str]:
    """Run `xrl demo` of a tree; return its exit code and what it said."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.cli", "demo", *words],
        cwd=tree, env=environment(tree), text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl-C is for us, who then interrupt it
    )  # fmt: skip
    try:
        said = process.communicate(timeout=PATIENCE_S)[0]
    except subprocess.TimeoutExpired:
        raise RunError(f"{tree}: `xrl demo` has not ended after {PATIENCE_S:g} s") from None
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=ENDING_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
    return process.returncode, said


def figures(summary: Mapping[str, Any], first_use: Array) -> Turn:
    """Return a run's figures, from its summary.json and `first_use_ms`."""
    ages: dict[str, float] = {}
    if first_use.size:
        ages["median"], ages["p99"] = np.percentile(first_use, [50.0, 99.0]).tolist()
    known = {**summary, FIRST_USE: ages}
    return {figure.name: _at(known, figure.path) for figure in FIGURES}


def _at(known: Any, path: Sequence[str]) -> float | None:
    for key in path:
        known = known.get(key) if known else None
    found: float | None = known
    return found


def first_use_ms(log: RunLog) -> Array:
    """Return the age of each command in the cycle that took it, ms, of all modules: (n,) floats.

    The age counts from the module's state that the command echoes. Commands to hold are left out,
    and those that the log does not have.
    """
    ages = []
    for module in MODULES:
        commands: list[JointCommand] = log.messages(topics.JOINT_COMMAND, module)
        echo_ns = {(c.session, c.seq): c.echo_t_ns for c in commands if not c.hold}
        traces: list[JointTrace] = log.messages(topics.JOINT_TRACE, module)
        for trace in traces:
            for cycle in trace.cycles:
                sampled_ns = echo_ns.get((cycle.session, cycle.command_seq))
                if sampled_ns is not None:
                    ages.append((cycle.now_ns - sampled_ns) / NS_PER_MS)
    return np.array(ages)


def rows(here: Sequence[Turn], there: Sequence[Turn], pace: float) -> list[Row]:
    """Return the rows of this tree's turns, beside the other tree's; targets are of pace 1."""
    return [
        compared(
            figure.what,
            figure.unit,
            [turn[figure.name] for turn in here],
            [turn[figure.name] for turn in there],
            figure.most if pace == 1.0 else None,
        )
        for figure in FIGURES
    ]


class FleetFlags(AgainstFlags):
    """What is led."""

    scenario: Annotated[str, Arg(metavar="NAME|FILE")] = "squat"
    """what happens, as of `xrl demo` (default: squat, the paper's Fig. 7)"""
    pace: Annotated[float, Range(PACE_MIN, 1.0, ""), Arg(metavar="X")] = 1.0
    """clock rate of the fleet; it is not lowered on full cores, and the targets are those of 1"""


def run(flags: FleetFlags) -> int:
    """Lead each tree in turn and print the medians; with --strict a missed target is a fault."""
    require("sim")
    robot = config_file.load(flags.config)
    gain_schedule.require(robot, flags.config)
    console = Console()
    warn_of_others(console)
    config = flags.config.resolve()
    turns: list[list[Turn]] = []
    with ExitStack() as stack:
        trees = [(CHECKOUT, config)]
        if flags.against is not None:
            other = stack.enter_context(unpacked(flags.against))
            trees.append((other, its_config(config, other)))
        runs = [tree for _ in range(flags.rounds or ROUNDS) for tree in trees]
        led = [
            measure(tree, its, flags.scenario, flags.pace)
            for tree, its in track(runs, "leading", console=console, transient=True)
        ]
        turns = [led[number :: len(trees)] for number in range(len(trees))]
    found = rows(turns[0], turns[1] if len(turns) > 1 else (), flags.pace)
    compare = ("least .. most",) if flags.against is None else (flags.against, "ratio")
    print_table(
        console,
        ("", "here", *compare, "target"),
        [_cells(row, flags.against) for row in found],
        "Medians of the turns. CPU: in percent of one core. Late: later than two periods. "
        "Age: of a command, from the module's state that it answers to the cycle that takes it.",
    )
    write_rows(flags.json, [{**row._asdict(), "figure": row.what} for row in found])
    return FAULT_EXIT_CODE if flags.strict and not all(row.ok for row in found) else 0


def _cells(row: Row, against: str | None) -> list[Text | str]:
    cells: list[Text | str] = [row.what, _number(row.value, row.unit)]
    if against is None:
        cells.append("" if row.spread is None else " .. ".join(map(digits, row.spread)))
    else:
        cells += [_number(row.other, row.unit), ratio_cell(row)]
    return [*cells, row.marked_target()]


def _number(value: float | None, unit: str) -> str:
    return "" if value is None else f"{digits(value)} {unit}"
