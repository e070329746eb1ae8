"""`xrl down`: stop the fleet and leave nothing behind."""

from __future__ import annotations

import argparse

from tools.fleet import procfs
from tools.fleet.supervise import SupervisedFleet
from tools.verb_table import Subparsers, add_run_dir, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "down",
        """
        xrl down
        xrl down --run-dir /tmp/bench
        xrl down --keep-stops      # from a systemd unit
        """,
    )
    add_run_dir(parser)
    parser.add_argument(
        "--keep-stops",
        action="store_true",
        help="an emergency stop holds on in the next `xrl up --disarmed`",
    )


def run(args: argparse.Namespace) -> int:
    """Stop every service, also of a fleet whose supervisor is dead; keep the logs."""
    fleet = SupervisedFleet(args.run_dir)
    was_up = fleet.run.is_marked and fleet.run.read_manifest() is not None
    was_up |= bool(procfs.fleet_pids(fleet.run.path))  # its directory may have been removed
    fleet.stop(keep_logs=True, keep_stops=args.keep_stops)
    if was_up:
        print(f"the fleet in {fleet.run.path} is down; its logs stay in {fleet.run.logs}")
    else:
        print(f"no fleet was up in {fleet.run.path}")
    return 0
