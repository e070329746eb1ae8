"""Leads the fleet of a source tree live, and reads from its record what it costs and achieves."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared.bus import topics
from shared.bus.messages import JointCommand
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_MS
from shared.exceptions import RunError
from shared.joints import MODULES
from tools.lab.bench.revisions import environment
from tools.logs.run_log import RunLog, read_run

Array = NDArray[np.float64]

PATIENCE_S: Final = 600.0
"""A run that has not ended by then is ended."""
ENDING_S: Final = 30.0
"""Time for an interrupted run to end its fleet."""

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


FIGURES: Final = (
    Figure("tick_us", "tick, median", "us", 300.0),
    Figure("tick_p99_us", "tick, p99", "us", None),
    Figure("cpu_pct", "CPU, all processes", "%", 110.0),
    Figure("late_pct", "PD cycles late", "%", 0.5),
    Figure("first_use_ms", "age at first use, median", "ms", None),
    Figure("first_use_p99_ms", "age at first use, p99", "ms", 3.0),
    Figure("hand_n", "hand's peak", "N", 40.0),
    Figure("com_x_mm", "COM x, led", "mm", 20.0),
)


class FleetRow(NamedTuple):
    """One figure over all turns."""

    figure: Figure
    value: float | None
    """Median of the turns."""
    spread: tuple[float, float] | None
    """Least and most of the turns."""
    other: float | None
    """The other revision's median."""
    ratio: float | None
    """This tree's value over the other's, turn by turn, in the median."""
    target: float | None

    @property
    def ok(self) -> bool:
        """True unless the target is missed."""
        return self.target is None or self.value is None or self.value <= self.target

    def as_dict(self) -> dict[str, object]:
        """Return it for a file."""
        return {**self._asdict(), "figure": self.figure.what, "unit": self.figure.unit}


def measure(tree: Path, config: Path, scenario: str, pace: float) -> Turn:
    """Lead a tree's fleet through a scenario, live.

    Args:
        tree: source tree to run; its record is read by this one.
        config: robot file.
        scenario: name or file, as of `xrl demo`.
        pace: of the fleet's clock; it is kept, however full the cores are.

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
    """Return a run's figures.

    Args:
        summary: the run's summary.json.
        first_use: ages of commands, ms (`first_use_ms`).
    """
    tick = summary.get("planner_tick_us") or {}
    found: Turn = {
        "tick_us": tick.get("median"),
        "tick_p99_us": tick.get("p99"),
        "cpu_pct": summary.get("fleet_cpu_pct"),
        "late_pct": summary.get("pd_cycles_late_pct"),
        "first_use_ms": None,
        "first_use_p99_ms": None,
        "hand_n": summary.get("operator_peak_n"),
        "com_x_mm": summary.get("alive_com_x_max_mm"),
    }
    if first_use.size:
        middle, most = np.percentile(first_use, [50.0, 99.0]).tolist()
        found |= {"first_use_ms": middle, "first_use_p99_ms": most}
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


def rows(here: Sequence[Turn], there: Sequence[Turn], pace: float) -> list[FleetRow]:
    """Return the table's rows.

    Args:
        here: turns of this tree; at least one.
        there: of the other tree, in turn with them; empty: none.
        pace: of all; targets are those of pace 1.
    """
    return [_row(figure, here, there, pace) for figure in FIGURES]


def _row(figure: Figure, here: Sequence[Turn], there: Sequence[Turn], pace: float) -> FleetRow:
    values, others = _known(figure, here), _known(figure, there)
    pairs = [(a[figure.name], b[figure.name]) for a, b in zip(here, there, strict=False)]
    return FleetRow(
        figure,
        _middle(values),
        (min(values), max(values)) if values else None,
        _middle(others),
        _middle([a / b for a, b in pairs if a is not None and b]),
        figure.most if pace == 1.0 else None,
    )


def _known(figure: Figure, turns: Sequence[Turn]) -> list[float]:
    return [value for turn in turns if (value := turn[figure.name]) is not None]


def _middle(values: Sequence[float]) -> float | None:
    return median(values) if values else None
