"""`xrl bench bus`: the fleet's pattern of messages over every transport that is installed.

Six modules and a planner, each a process of its own (`bus_process.py`).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Annotated, Final, NamedTuple

import msgspec
import numpy as np
from rich.progress import track

from shared.exceptions import RunError
from shared.extras import missing_package
from shared.joints import MODULES
from shared.places import CHECKOUT
from tools.flags import Arg, Duration
from tools.lab.bench.bus_process import PLANNER, WARM_UP_S, BusReport
from tools.lab.bench.table import BenchFlags, print_table, write_rows
from tools.lab.bench.transports import TRANSPORTS, installed
from tools.terminal import Console

ROUNDS: Final = 3
PATIENCE_S: Final = 20.0
"""Beyond its time, a process that has not ended by then failed."""


class BusFigures(NamedTuple):
    """One transport's figures."""

    transport: str
    p50_us: float
    """From the planner's put to a module's take, at the module's cycles of 2 ms."""
    p99_us: float
    p999_us: float
    missed: float
    """Fraction of commands that came a cycle later than they could have."""
    lost: float
    """Fraction of commands that were never taken."""
    cpu: float
    """CPU time of the seven processes, as a fraction of one core."""


def measure(transport: str, seconds: float) -> BusFigures:
    """Run the pattern once, for so many seconds after the warm-up."""
    with tempfile.TemporaryDirectory(prefix="xrl-bus-") as folder:
        processes: list[subprocess.Popen[str]] = []
        try:
            names = (*MODULES, PLANNER)
            processes.extend(_start(transport, name, Path(folder), seconds) for name in names)
            reports = [_report(transport, one, seconds) for one in processes]
        finally:
            for one in processes:
                one.kill()
                one.communicate()
    return figures(transport, reports)


def figures(transport: str, reports: Sequence[BusReport]) -> BusFigures:
    """Return a transport's figures from its seven processes' reports."""
    latencies = np.concatenate([report.latency_us for report in reports])
    if not latencies.size:
        raise RunError(f"{transport}: no command arrived")
    p50, p99, p999 = np.percentile(latencies, [50.0, 99.0, 99.9]).tolist()
    lost = sum(report.lost for report in reports)
    return BusFigures(
        transport,
        p50,
        p99,
        p999,
        sum(report.missed for report in reports) / latencies.size,
        lost / (latencies.size + lost),
        sum(report.cpu_s / report.wall_s for report in reports),
    )


def median_of(rounds: Sequence[BusFigures]) -> BusFigures:
    """Return the medians of a transport's rounds."""
    columns = zip(*(row[1:] for row in rounds), strict=True)
    return BusFigures(rounds[0].transport, *(median(column) for column in columns))


def _start(transport: str, name: str, folder: Path, seconds: float) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tools.lab.bench.bus_process", transport, name, str(folder),
         "--seconds", str(seconds)],
        cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def _report(transport: str, process: subprocess.Popen[str], seconds: float) -> BusReport:
    try:
        out, errors = process.communicate(timeout=seconds + WARM_UP_S + PATIENCE_S)
    except subprocess.TimeoutExpired:
        raise RunError(f"{transport}: a process did not end") from None
    if process.returncode:
        last = (errors.strip().splitlines() or ["it said nothing"])[-1]
        raise RunError(f"{transport}: a process ended with {process.returncode}: {last}")
    return msgspec.json.decode(out.strip().splitlines()[-1], type=BusReport)


class BusFlags(BenchFlags):
    """Which transports, and how long."""

    transport: Annotated[
        tuple[str, ...], Arg(choices=tuple(row.name for row in TRANSPORTS), metavar="NAME")
    ] = ()
    """measure only this one; may be repeated (default: all that are installed; those beyond Zenoh
    and
    datagrams come with the extra `bench`)"""
    seconds: Duration = 10.0
    """of each run"""


def run(flags: BusFlags) -> int:
    """Measure the transports in turn and print their medians."""
    present = installed()
    names = flags.transport or list(present)
    for name in names:
        if name not in present:
            raise missing_package("bench", [name])
    console = Console()
    rounds = [
        [measure(name, flags.seconds) for name in names]
        for _ in track(range(flags.rounds or ROUNDS), "measuring", console=console, transient=True)
    ]
    rows = [median_of(column) for column in zip(*rounds, strict=True)]
    print_table(
        console,
        {
            "": [row.transport for row in rows],
            "p50": [f"{row.p50_us * 1e-3:.2f} ms" for row in rows],
            "p99": [f"{row.p99_us * 1e-3:.2f} ms" for row in rows],
            "p99.9": [f"{row.p999_us * 1e-3:.2f} ms" for row in rows],
            "missed": [f"{100.0 * row.missed:.2f} %" for row in rows],
            "lost": [f"{100.0 * row.lost:.2f} %" for row in rows],
            "CPU": [f"{100.0 * row.cpu:.0f} %" for row in rows],
        },
        "From the planner's put to a module's cycle, every 2 ms; medians of the rounds. "
        "Missed: a command came a cycle later than it could have. CPU: of all seven processes, in "
        "percent of one core.",
    )
    write_rows(flags.json, [row._asdict() for row in rows])
    return 0
