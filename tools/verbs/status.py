"""`xrl status`: every service and every module."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import msgspec

from shared.bus.session import open_session
from shared.config.files import load
from tools.fleet.bus_faults import BusFaults
from tools.fleet.fleet_status import RateMonitor, listen_for_all, monitors_of, read_status
from tools.fleet.status_table import tables
from tools.fleet.supervise import SupervisedFleet
from tools.terminal import Console, renewed
from tools.verb_table import Subparsers, add_run_dir, add_verb


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
    fleet = SupervisedFleet.attach(args.run_dir, warn=False)  # it is in the table
    robot = load(Path(fleet.manifest.config))
    security = robot.bus.security.mode
    with open_session(robot, "status", fleet.run.path) as session:
        monitors = monitors_of(session, fleet.manifest.topics)
        listen_for_all(monitors)
        bus = BusFaults(robot, session)
        if args.watch:
            _watch(fleet, monitors, security, bus)
        else:
            status = read_status(fleet, monitors, security, bus)
            if args.json:
                print(msgspec.json.format(msgspec.json.encode(status)).decode())
            else:
                Console().print(tables(status))
    return 0


def _watch(
    fleet: SupervisedFleet, monitors: Mapping[str, RateMonitor], security: str, bus: BusFaults
) -> None:
    with renewed(Console()) as show:
        while True:
            show(tables(read_status(fleet, monitors, security, bus)))
