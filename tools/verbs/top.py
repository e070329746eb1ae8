"""`xrl top`: processes and topics of a fleet on one screen, renewed until Ctrl-C."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from rich.console import Group

from shared.bus.session import open_session
from shared.clock import pace
from shared.config.files import load
from shared.process import StopFlag
from tools.fleet.process_table import services_elsewhere
from tools.fleet.procfs import use_of
from tools.fleet.status_table import process_table
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.traffic import LINKS_S, Traffic, traffic_table
from tools.terminal import Console, renewed
from tools.topic_keys import keys_named
from tools.verb_table import Subparsers, add_run_dir, add_verb

WINDOW_S: Final = 1.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "top",
        """
        xrl top
        xrl top --once
        """,
    )
    add_run_dir(parser)
    parser.add_argument("--once", action="store_true", help="print one screen and end")


def run(args: argparse.Namespace) -> int:
    """Show until interrupted."""
    fleet = SupervisedFleet.attach(args.run_dir)
    robot = load(Path(fleet.manifest.config))
    console, stop = Console(), StopFlag()
    with open_session(robot, "top", fleet.run.path) as session:
        elsewhere = services_elsewhere(robot, fleet.run.path)
        traffic = Traffic(session, keys_named(()), elsewhere)
        traffic.listen(LINKS_S)
        if args.once:
            console.print(_screen(fleet, traffic, stop))
            return 0
        with renewed(console, screen=True) as show:
            while not stop:
                show(_screen(fleet, traffic, stop))
    return 0


def _screen(fleet: SupervisedFleet, traffic: Traffic, stop: StopFlag) -> Group:
    """Watch for a window, and return what was seen; rates are those of the fleet's clock."""
    services = fleet.info()
    pids = [row.pid for row in services if row.pid]
    before = use_of(pids)
    window_s = traffic.listen(WINDOW_S, lambda: bool(stop))
    processes = process_table(services, before, use_of(pids), window_s)
    return Group(processes, traffic_table(traffic, window_s * pace(), only_seen=True))
