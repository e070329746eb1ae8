"""`xrl kill`: send a signal to one service."""

from __future__ import annotations

import argparse
import signal
from typing import Final

from shared.joints import MODULES
from tools.fleet.supervise import SupervisedFleet
from tools.verb_table import Subparsers, add_run_dir, add_verb

SIGNALS: Final = {
    "KILL": signal.SIGKILL,
    "STOP": signal.SIGSTOP,
    "CONT": signal.SIGCONT,
    "TERM": signal.SIGTERM,
}


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "kill",
        """
        xrl kill planner                        # dead at once; the supervisor starts it again
        xrl kill planner --signal STOP          # frozen, as a hung process is
        xrl kill planner --signal CONT          # and on again
        xrl kill knee_left                      # its drive holds; the next service takes it over
        """,
    )
    parser.add_argument("service", metavar="SERVICE", help="a name that `xrl status` shows")
    parser.add_argument(
        "--signal", choices=tuple(SIGNALS), default="KILL", help="default: %(default)s"
    )
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Send the signal."""
    fleet = SupervisedFleet.attach(args.run_dir)
    if args.signal in ("KILL", "TERM") and args.service in MODULES:
        fleet.forget(args.service)  # a person asked for its next process: it may arm the drive
    pid = fleet.kill(args.service, SIGNALS[args.signal])
    print(f"{args.service} (pid {pid}): {args.signal} sent")
    return 0
