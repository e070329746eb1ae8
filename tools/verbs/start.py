"""`xrl start`: start a service that is down, or continue one that is stopped."""

from __future__ import annotations

import argparse

from tools.fleet.supervise import SupervisedFleet
from tools.verb_table import Subparsers, add_run_dir, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "start",
        """
        xrl start planner       # after `xrl up --no-planner`: it leads once all six are ready
        xrl start knee_left     # at once, where the supervisor waits after several failures
        """,
    )
    parser.add_argument("service", metavar="SERVICE", help="a name that `xrl status` shows")
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Start it."""
    runs = SupervisedFleet.attach(args.run_dir).start_service(args.service)
    if runs is not None:
        print(f"{args.service}: runs already, as process {runs}; nothing was done")
    else:
        print(f"{args.service}: started; `xrl status` shows how it does")
    return 0
