"""Traffic and processes as tables for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from tools.fleet.procfs import ProcessUse
from tools.fleet.status_table import GOOD_STATES
from tools.fleet.supervisor_client import ServiceInfo
from tools.fleet.traffic import KeyTraffic, Traffic, rate_hz


def traffic_table(traffic: Traffic, window_s: float, *, only_seen: bool = False) -> Table:
    """Return one row for each key.

    Args:
        traffic: of a window.
        window_s: its length, s of the fleet's clock.
        only_seen: leave out keys on which nothing has come.
    """
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("topic", no_wrap=True)
    for heading in ("Hz", "apart ms", "age ms", "bytes", "kB/s", "lost"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in traffic.keys.values():
        if one.count or not only_seen:
            table.add_row(one.key.name, *_cells(one, window_s))
    return table


def _cells(one: KeyTraffic, window_s: float) -> list[str]:
    """Return rate and nominal rate, spacing and age (median, largest), size, flow and losses."""
    nominal = f"/{one.key.topic.rate_hz:g}" if one.key.topic.rate_hz else ""
    return [
        f"{rate_hz(one, window_s):.0f}{nominal}" if one.count else f"-{nominal}",
        _two(one.gaps_ms),
        _two(one.ages_ms),
        f"{one.size / one.count:.0f}" if one.count else "-",
        f"{one.size / window_s / 1e3:.1f}" if one.count else "-",
        str(one.lost) if one.lost else "",
    ]


def _two(values: tuple[float, float] | None) -> str:
    return "-" if values is None else f"{values[0]:.1f}/{values[1]:.1f}"


def process_table(
    services: Sequence[ServiceInfo],
    before: Mapping[int, ProcessUse],
    after: Mapping[int, ProcessUse],
    window_s: float,
) -> Table:
    """Return one row for each process, and their sum.

    Args:
        services: by the supervisor.
        before: use at the window's begin, by process id.
        after: at its end.
        window_s: its length, s of the machine's clock.
    """
    table = Table(box=box.SIMPLE_HEAD, show_footer=True)
    shares = {
        pid: 100.0 * (use.cpu_s - before[pid].cpu_s) / window_s
        for pid, use in after.items()
        if pid in before
    }
    total, memory = sum(shares.values()), sum(use.memory_mib for use in after.values())
    table.add_column("process", "all", no_wrap=True)
    table.add_column("state", no_wrap=True)
    for heading, footer in (
        ("pid", ""), ("CPU % of a core", f"{total:.1f}"), ("MiB", f"{memory:.0f}"),
        ("up s", ""), ("restarts", ""),
    ):  # fmt: skip
        table.add_column(heading, footer, justify="right", no_wrap=True)
    for row in services:
        pid = row.pid or 0
        table.add_row(
            row.name,
            row.state if row.state in GOOD_STATES else Text(row.state, "bold red"),
            str(row.pid or "-"),
            f"{shares[pid]:.1f}" if pid in shares else "-",
            f"{after[pid].memory_mib:.0f}" if pid in after else "-",
            f"{row.uptime_s:.0f}",
            str(row.restarts),
        )
    return table
