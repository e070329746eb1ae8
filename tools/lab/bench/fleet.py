"""`xrl bench fleet`: leads the whole fleet live, and measures its cost and quality."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import numpy as np

from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import JointCommand
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_MS
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.extras import require
from shared.joints import MODULES
from shared.places import CHECKOUT
from shared.toml_file import Range
from tools.flags import Arg
from tools.fleet.pace import PACE_MIN
from tools.fleet.status_table import warn_of_others
from tools.lab.bench import bus
from tools.lab.bench.table import AgainstFlags, Figure, Turn, finish, row_of, run_tree, run_turns
from tools.logs.run_log import RunLog, read_run
from tools.terminal import Console

FIRST_USE: Final = "first_use_ms"
"""Ages of commands, which this bench reads from the record."""
OVER_FLOOR: Final = "cpu_over_floor"
"""CPU of the fleet relative to seven processes that only exchange its messages, `bench bus`."""
FLOOR_S: Final = 8.0
FIGURES: Final = {
    ("planner_tick_us", "median"): Figure("tick, median", "us", 300.0),
    ("planner_tick_us", "p99"): Figure("tick, p99", "us"),
    ("fleet_cpu_pct",): Figure("CPU, all processes", "%", 110.0),
    (OVER_FLOOR,): Figure("CPU, over that of the messages alone", "", 2.0),
    ("pd_cycles_late_pct",): Figure("PD cycles late", "%", 0.5),
    (FIRST_USE, "median"): Figure("age at first use, median", "ms"),
    (FIRST_USE, "p99"): Figure("age at first use, p99", "ms", 3.0),
    ("operator_peak_n",): Figure("hand's peak", "N", 40.0),
    ("alive_com_x_max_mm",): Figure("COM x, led", "mm", 20.0),
}
"""Figures with the targets of docs/results.md#targets at pace 1, by their place in a run's summary
or below `FIRST_USE`."""


class FleetFlags(AgainstFlags):
    """Scenario and pace."""

    scenario: Annotated[str, Arg(metavar="NAME|FILE")] = "squat"
    """file, or name of a scenario, shipped or in scenarios/ beside the robot file (default: squat,
    the paper's Fig. 7)"""
    pace: Annotated[float, Range(PACE_MIN, 1.0, ""), Arg(metavar="X")] = 1.0
    """clock rate of the fleet, not lowered if the cores are full; the targets apply at 1"""


def run(flags: FleetFlags) -> int:
    """Lead the fleet and print the medians; with --strict a missed target is a fault."""
    require("sim")
    gain_schedule.require(config_file.load(flags.config), flags.config)
    console = Console()
    warn_of_others(console)
    words = ["--scenario", flags.scenario, "--pace", f"{flags.pace:g}"]
    demo = ["demo", "--config", str(flags.config), *words]
    here, there = run_turns(
        flags, ["bench", "fleet", *words], flags.rounds or 3, lambda: measure(demo), console
    )
    kept = [
        figure if flags.pace == 1.0 else figure._replace(target=None) for figure in FIGURES.values()
    ]
    note = (
        "Medians of the turns. CPU: in percent of one core. Late: later than two periods. "
        "Age: of a command, from the state that it echoes to the cycle that applies it. "
        "Messages alone: `xrl bench bus --transport zenoh`, without laws, drives and a recorder."
    )
    return finish(flags, [row_of(figure, here, there) for figure in kept], note, console)


def measure(demo: Sequence[str]) -> Turn:
    """Lead this tree's fleet through a scenario, live, and read its record.

    Raises:
        RunError: the demo ended with an exit code other than 0, for example after a fall.
    """
    with tempfile.TemporaryDirectory(prefix="xrl-fleet-") as folder:
        out = Path(folder) / "run"
        run_tree(CHECKOUT, [*demo, "--out", str(out)])
        summary = msgspec.json.decode((out / "summary.json").read_bytes())
        if summary["fleet_cpu_pct"] is not None and summary["pace"] == 1.0:
            summary[OVER_FLOOR] = summary["fleet_cpu_pct"] / bus.measure("zenoh", FLOOR_S)["CPU %"]
        return figures(summary, first_use_ms(read_run(out)))


def figures(summary: Mapping[str, Any], first_use: Array) -> Turn:
    """Return a run's figures, from its summary.json and `first_use_ms`; None if unknown."""
    ages: dict[str, float] = {}
    if first_use.size:
        ages["median"], ages["p99"] = np.percentile(first_use, [50.0, 99.0]).tolist()
    known: Any = {**summary, FIRST_USE: ages}
    return {
        figure.what: (known.get(path[0]) or {}).get(path[1]) if path[1:] else known.get(path[0])
        for path, figure in FIGURES.items()
    }


def first_use_ms(log: RunLog) -> Array:
    """Return the age of each command in the cycle that applied it, ms, of all modules: (n,) floats.

    The age counts from the module's state that the command echoes. Commands to hold, and commands
    that are missing from the log, are left out.
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
