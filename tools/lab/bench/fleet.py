"""`xrl bench fleet`: the whole fleet, led live; one revision beside another.

Its record tells what it costs and achieves.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
from rich.progress import track

from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import JointCommand
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_MS
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.exceptions import RunError
from shared.extras import require
from shared.joints import MODULES
from shared.toml_file import Range
from tools.flags import Arg
from tools.fleet.pace import PACE_MIN
from tools.fleet.status_table import warn_of_others
from tools.judge.verdict_table import digits
from tools.lab.bench.revisions import environment
from tools.lab.bench.revisions import trees as trees_of
from tools.lab.bench.table import (
    AgainstFlags,
    Row,
    cell,
    compared,
    compared_columns,
    print_table,
)
from tools.logs.run_log import RunLog, read_run
from tools.terminal import Console

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
    with trees_of(flags) as trees:
        runs = [tree for _ in range(flags.rounds or ROUNDS) for tree in trees]
        led = [
            measure(tree, its, flags.scenario, flags.pace)
            for tree, its in track(runs, "leading", console=console, transient=True)
        ]
    here, *there = (led[number :: len(trees)] for number in range(len(trees)))
    found = rows(here, there[0] if there else (), flags.pace)
    if flags.against is None:
        spreads = (() if row.spread is None else map(digits, row.spread) for row in found)
        compare = {"least .. most": [" .. ".join(spread) for spread in spreads]}
    else:
        compare = compared_columns(found, flags.against, units=True)
    print_table(
        console,
        {
            "": [row.what for row in found],
            "here": [cell(row.value, row.unit) for row in found],
            **compare,
            "target": [row.marked_target() for row in found],
        },
        "Medians of the turns. CPU: in percent of one core. Late: later than two periods. "
        "Age: of a command, from the module's state that it answers to the cycle that takes it.",
    )
    return flags.finish(found, [{"figure": row.what} for row in found])
