"""`xrl view`: the robot in a browser."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

from shared import places
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, RunError
from shared.extras import require
from shared.process import StopFlag
from tools.fleet.supervise import SupervisedFleet
from tools.judge.run_parts import add_part, read_asked
from tools.live.experiment import load_robot
from tools.logs.run_index import RunIndex
from tools.logs.run_log import robot_of
from tools.output import progress_along, write_atomically
from tools.terminal import Console, marked
from tools.verb_table import RUN_HELP, Subparsers, add_config, add_run_dir, add_verb
from tools.view.live import LiveSource
from tools.view.lockstep import LockstepSource
from tools.view.record import RecordSource, single_file
from tools.view.serving import add_port, serve
from tools.view.source import FOXGLOVE_PORT, HOST, PORT, Source


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "view",
        """
        xrl view                       # the fleet that is up: look, and touch nothing
        xrl view --act                 # ... and lead, push, kill, freeze, start, cut, stop
        xrl view out/demo/run.mcap     # a record: play, pause, step, scrub
        xrl view out/demo/run.mcap --html run.html     # ... as one file that opens anywhere
        xrl view --foxglove            # the same for Foxglove: connect it to the printed address
        xrl view --sim                 # a robot in this process: lead it, push it, kill its planner
        """,
    )
    parser.add_argument("record", nargs="?", type=Path, metavar="RUN", help=RUN_HELP)
    parser.add_argument("--sim", action="store_true", help="a robot of its own, in virtual time")
    parser.add_argument(
        "--html",
        type=Path,
        metavar="FILE",
        help="write the record into one HTML file that needs no server, and end",
    )
    parser.add_argument(
        "--act",
        action="store_true",
        help="let the page act on the fleet that is up; a real robot's name has to be typed first",
    )
    add_port(parser)
    parser.add_argument(
        "--foxglove",
        action="store_true",
        help=f"serve the frames to Foxglove in place of a page (port: {FOXGLOVE_PORT})",
    )
    add_part(parser)
    add_config(parser, before="that of the record or of the fleet")
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    if args.sim:
        require("sim")
    if args.html is None and not args.foxglove:
        require("view", "write it as one page: --html FILE" if args.record is not None else "")
    if args.sim and args.record is not None:
        raise RunError("a record and --sim do not go together; leave one out")
    if args.act and (args.sim or args.record is not None):
        raise RunError("--act is for the fleet that is up; --sim needs none, a record takes none")
    if args.html is not None:
        if args.record is None:
            raise RunError("--html is for a record: name one")
        return _write(args)
    if args.foxglove:
        if args.record is not None or args.act:
            raise RunError("--foxglove only looks, at a fleet or at --sim; it opens records itself")
        return _serve_foxglove(args)
    with _source(args) as source:
        serve(source, args.port)
    return 0


@contextlib.contextmanager
def _source(args: argparse.Namespace) -> Iterator[Source]:
    if args.sim:
        lockstep = LockstepSource(load_robot(places.robot_file(args.config)))
        try:
            yield lockstep
        finally:
            lockstep.close()
    elif args.record is not None:
        log = read_asked(args, RunIndex(args.record))
        yield RecordSource(log, robot_of(log))
    else:
        fleet = SupervisedFleet.attach(args.run_dir)
        robot = config_file.load(Path(fleet.manifest.config))
        if args.act and "simulator" not in fleet.manifest.services:
            confirm(robot)
        live = LiveSource(robot, fleet, act=args.act)
        try:
            yield live
        finally:
            live.disconnect()


def _serve_foxglove(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    require("foxglove")
    from tools.view.foxglove_server import FoxgloveServer  # noqa: PLC0415 - needs the extra

    stop = StopFlag()
    with _source(args) as source:
        port = FOXGLOVE_PORT if args.port == PORT else args.port
        server = FoxgloveServer(source, port)
        print(f"ws://{HOST}:{server.port}  (in Foxglove: open a connection; Ctrl-C ends it)")
        sys.stdout.flush()
        server.serve(lambda: bool(stop))
    return 0


def _write(args: argparse.Namespace) -> int:
    """Write a record into one file."""
    log = read_asked(args, RunIndex(args.record))
    source = RecordSource(log, robot_of(log))
    model = source.model()
    with progress_along("frames", model.end_s - model.begin_s) as done:
        content = single_file(source, done)
    write_atomically(args.html, content)
    print(f"{args.html}: {model.end_s - model.begin_s:.1f} s, {len(content) / 1e6:.1f} MB")
    return 0


def confirm(robot: RobotConfig) -> None:
    """Have a person type the name of a real robot that a page may act on.

    Raises:
        FleetError: there is nobody to ask, or it is another name.
    """
    if not sys.stdin.isatty():
        raise FleetError("a page may act on a real robot only if somebody types its name here")
    console = Console()
    console.print(
        marked(
            "[bold red]This is a real robot.[/] A page can kill its services and stop it, and "
            "replaces no switch that cuts the power."
        )
    )
    typed = console.input(f"Type its name ({robot.name}) to go on: ")
    if typed.strip() != robot.name:
        raise FleetError(f"{typed.strip()!r} is another name; nothing was started")
