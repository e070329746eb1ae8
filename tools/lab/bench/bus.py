"""Runs the fleet's pattern over a transport: six modules and a planner, each its own process."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

import msgspec
import numpy as np

from shared.exceptions import RunError
from shared.joints import MODULES
from shared.places import CHECKOUT
from tools.lab.bench.bus_process import PLANNER, WARM_UP_S, BusReport

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
    """Run the pattern once.

    Args:
        transport: name of an installed one.
        seconds: measured, after the warm-up.

    Raises:
        RunError: a process failed, or no command arrived.
    """
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
    """Return a transport's figures from its seven processes' reports.

    Raises:
        RunError: no command arrived.
    """
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
