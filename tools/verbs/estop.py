"""`xrl estop`: every module to DAMP, now, by shared memory and over the bus."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console

from shared.config.files import load
from shared.exceptions import FleetError, XrlError
from tools.fleet.emergency_stop import GIVE_UP_S, request_here, stop_all, wait_here
from tools.fleet.supervise import SupervisedFleet
from tools.verb_table import Subparsers, add_run_dir, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "estop",
        """
        xrl estop
        xrl estop --run-dir /tmp/lab
        xrl estop --local                       # on the robot's own host: needs no bus
        xrl estop --config lab.toml             # from another computer, with an operator's key
        """,
    )
    add_run_dir(parser, Path)  # whoever can reach the robot may stop it
    parser.add_argument(
        "--local",
        action="store_true",
        help="only by shared memory, to the joint services on this host (default: both ways)",
    )
    parser.add_argument(
        "--partly",
        action="store_true",
        help="with --local: the other modules are on other hosts (default: all six must stop)",
    )
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="robot file (default: that of the fleet in the run directory)",
    )


def run(args: argparse.Namespace) -> int:
    """Repeat the stop until every module has stopped; only a restart leaves DAMP."""
    run_dir: Path = args.run_dir
    if args.partly and not args.local:
        raise FleetError("--partly goes with --local: over the bus all six have to stop")
    here, errors = request_here(run_dir)  # first: it needs no bus and no supervisor
    for line in errors:
        print(f"xrl: {line}", file=sys.stderr)
    if args.local:
        if not here:
            raise FleetError(f"{run_dir}: no joint service of a fleet is on this host")
        going = wait_here(run_dir, here, partly=args.partly)
    else:
        try:
            config = args.config or Path(SupervisedFleet.attach(run_dir).manifest.config)
            going = stop_all(load(config), run_dir)
        except XrlError as error:
            if not here:
                raise
            print(f"xrl: not over the bus: {error}", file=sys.stderr)
            going = wait_here(run_dir, here)
    if going:
        raise FleetError(f"not stopped after {GIVE_UP_S:g} s: {', '.join(going)}; cut the power")
    which = ", ".join(here) if args.partly else "all six modules"
    Console().print(
        f"{which} are stopped: DAMP. The robot sinks slowly, or holds beside a limp or dead "
        "module; `xrl down` ends it"
    )
    return 0
