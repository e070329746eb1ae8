"""`xrl status`: every service and every module."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table

from shared.bus.messages import DriveStatus
from shared.bus.session import open_session
from shared.config.files import load
from tools.fleet.fleet_status import (
    SILENT_PROXY,
    FleetStatus,
    LeadStatus,
    RateMonitor,
    ears_of,
    listen_for_all,
    look,
)
from tools.fleet.supervise import SupervisedFleet
from tools.verb_table import Subparsers, add_run_dir, add_verb

_LABELS: Final = ("state", "last exit")
_GOOD: Final = ("running", "starting")


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "status",
        """
        xrl status
        xrl status --watch
        xrl status --json | jq .services.planner
        """,
    )
    add_run_dir(parser)
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print JSON, in SI units")
    form.add_argument("--watch", action="store_true", help="keep showing until Ctrl-C")


def run(args: argparse.Namespace) -> int:
    """Look at the fleet once, or until interrupted."""
    fleet = SupervisedFleet.attach(args.run_dir)
    with open_session(load(Path(fleet.manifest.config)), "status", fleet.run.path) as session:
        monitors = ears_of(session, fleet.manifest.topics)
        listen_for_all(monitors)
        if args.watch:
            _watch(fleet, monitors)
        else:
            status = look(fleet, monitors)
            if args.json:
                print(msgspec.json.format(msgspec.json.encode(status)).decode())
            else:
                Console().print(tables(status))
    return 0


def describe_lead(lead: LeadStatus | None) -> str:
    """Return one line on the planner."""
    if lead is None:
        return "planner silent: each module holds by itself"
    words = f"planner {lead.mode}, margin {lead.margin:.2f}"
    if lead.wait_s > 0.0:
        words += f"; leads again in {lead.wait_s:.0f} s at the earliest, for links have dropped out"
    if lead.why:
        words += f"; {lead.why}"
    return words


def tables(status: FleetStatus) -> Group:
    """Return the status as two tables for the terminal, and what there is to say beside."""
    services = Table(
        title=f"services in {status.run_dir}", title_justify="left", box=box.SIMPLE_HEAD
    )
    services.add_column("service", no_wrap=True, min_width=max(map(len, status.services)))
    for heading in (
        "state",
        "pid",
        "up s",
        "age ms",
        "rate Hz",
        "restarts",
        "last exit",
    ):
        words = heading in _LABELS
        services.add_column(
            heading, justify="left" if words else "right", no_wrap=heading != "last exit"
        )
    for name, row in status.services.items():
        services.add_row(
            name,
            row.state if row.state in _GOOD else f"[bold red]{row.state}[/]",
            "-" if row.pid is None else str(row.pid),
            f"{row.uptime_s:.0f}",
            "-" if row.age_s is None else f"{1e3 * row.age_s:.0f}",
            "-" if row.rate_hz is None else f"{row.rate_hz:.0f}",
            str(row.restarts),
            row.last_exit,
        )
    modules = Table(title="modules", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("module", "mode", "tier", "because", "drive", "phi", "theta", "way out"):
        modules.add_column(heading, no_wrap=heading != "way out")
    for name, module in status.modules.items():
        mode = module.mode or "silent"
        if module.stiffened:
            mode = f"{mode}, stiffened"
        drive = module.drive or "-"
        angles = ("-", "-") if module.q is None else (f"{a:+.3f}" for a in module.q)
        modules.add_row(
            name,
            mode,
            str(module.tier or "-"),
            module.cause or "",
            drive if drive == DriveStatus.ARMED.name else f"[bold red]{drive}[/]",
            *angles,
            module.way_out.replace("MODULE", name),
        )
    way_out = "kill network_proxy" if SILENT_PROXY in status.network else "inject --clear"
    line = f"[bold yellow]impaired on purpose: {'; '.join(status.network)}[/] (xrl {way_out})"
    slow = f" in slow motion: the fleet's clock goes at {status.pace:g} of real time"
    lines = [f" {describe_lead(status.lead)}"]
    lines += [slow] if status.pace != 1.0 else []
    lines += [line] if status.network else []
    return Group(services, modules, *lines)


def _watch(fleet: SupervisedFleet, monitors: Mapping[str, RateMonitor]) -> None:
    with Live(tables(look(fleet, monitors)), console=Console(), auto_refresh=False) as live:
        while True:
            live.update(tables(look(fleet, monitors)), refresh=True)
