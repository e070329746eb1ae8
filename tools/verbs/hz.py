"""`xrl hz`: rate, spacing, age and size of topics."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from shared.bus.session import open_session
from shared.clock import pace
from shared.config.files import load
from shared.exceptions import FAULT_EXIT_CODE, FleetError
from shared.process import StopFlag
from tools.fleet.process_table import services_elsewhere
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.traffic import LINKS_S, Traffic, traffic_table
from tools.number_arguments import finite
from tools.terminal import Console, renewed
from tools.topic_keys import keys_named
from tools.verb_table import Subparsers, add_run_dir, add_verb

WINDOW_S: Final = 1.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "hz",
        """
        xrl hz 'joint/*/state'            # until Ctrl-C
        xrl hz planner/status --for 10    # one table over ten seconds
        xrl hz                            # every topic
        """,
    )
    add_run_dir(parser)
    parser.add_argument(
        "topic", nargs="*", metavar="TOPIC", help="such as 'joint/*/state' (default: all)"
    )
    parser.add_argument(
        "--for",
        dest="for_s",
        type=finite,
        metavar="S",
        help=f"measure for S seconds and print once; exit code {FAULT_EXIT_CODE} if nothing came",
    )


def run(args: argparse.Namespace) -> int:
    """Measure; time apart and age are median and largest of a window, as received here."""
    keys = keys_named(args.topic)
    if args.for_s is not None and not args.for_s > 0.0:
        raise FleetError(f"--for {args.for_s:g}: a time is right, such as 10")
    fleet = SupervisedFleet.attach(args.run_dir)
    robot = load(Path(fleet.manifest.config))
    console, stop = Console(), StopFlag()
    with open_session(robot, "hz", fleet.run.path) as session:
        traffic = Traffic(session, keys, services_elsewhere(robot, fleet.run.path))
        traffic.listen(LINKS_S)  # links form: what was waiting has no spacing
        if args.for_s is not None:
            window_s = traffic.listen(args.for_s, lambda: bool(stop))
            console.print(traffic_table(traffic, window_s * pace()))
            return 0 if any(one.count for one in traffic.keys.values()) else FAULT_EXIT_CODE
        with renewed(console) as show:
            while not stop:
                window_s = traffic.listen(WINDOW_S, lambda: bool(stop))
                show(traffic_table(traffic, window_s * pace()))
    return 0
