"""`xrl pendant`: a dead man's handle; once it ends, in whatever way, this host's modules stop."""

from __future__ import annotations

import argparse
import time
from typing import Final

from services.joint.rearm_guard import Pendant
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.process import StopFlag
from tools.fleet.emergency_stop import GIVE_UP_S, request_here, wait_here
from tools.keyboard import typed_line
from tools.number_arguments import finite
from tools.terminal import Console
from tools.verb_table import Subparsers, add_run_dir, add_verb

EVERY_S: Final = 0.02
OTHER_S: Final = 0.2
"""Wait in which another pendant's beats would show, s."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "pendant",
        """
        xrl pendant               # held until Enter lays it down; Ctrl-C is the stop
        xrl pendant --for 600     # laid down by itself after ten minutes
        """,
    )
    add_run_dir(parser)
    parser.add_argument(
        "--for", dest="for_s", type=finite, metavar="S", help="lay it down after S seconds"
    )


def run(args: argparse.Namespace) -> int:
    """Beat until it is laid down; 0 then, and after a stop that reached all modules of this host.

    Raises:
        FleetError: no joint service is on this host, somebody holds a pendant already, or a module
            does not stop.
    """
    if args.for_s is not None and not args.for_s > 0.0:
        raise FleetError(f"--for {args.for_s:g}: a time is right, such as 600")
    try:
        pendant = Pendant(args.run_dir, MODULES)
    except OSError as error:
        raise FleetError(
            f"{args.run_dir}: no shared memory for the pendant: {error.strerror}"
        ) from None
    if not pendant.modules:
        raise FleetError(f"{args.run_dir}: no joint service of a fleet is on this host")
    before = pendant.beats
    time.sleep(OTHER_S)
    if pendant.beats != before:
        raise FleetError("another pendant is held: lay that one down first")
    console, stop = Console(), StopFlag()
    elsewhere = [module for module in MODULES if module not in pendant.modules]
    if elsewhere:
        console.print(f"does not stop {', '.join(elsewhere)}: no service of theirs on this host")
    console.print("held: Enter lays it down; Ctrl-C, or this program's end, stops all modules")
    ends = None if args.for_s is None else time.monotonic() + args.for_s
    shown = None
    while not stop and shown != "":
        pendant.beat()
        shown = typed_line(EVERY_S)
        if shown or (ends is not None and time.monotonic() >= ends):
            pendant.lay_down()
            console.print("laid down: the robot continues without it")
            return 0
    request_here(args.run_dir)  # faster than the pendant's silence
    going = wait_here(args.run_dir, list(pendant.modules), pendant.modules)
    if going:
        raise FleetError(f"not stopped after {GIVE_UP_S:g} s: {', '.join(going)}; cut the power")
    console.print(
        "stopped: DAMP. It sinks slowly, or holds beside a limp or dead module; `xrl down` ends it"
    )
    return 0
