"""`xrl view`: the robot in a browser."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from shared.config import files as config_file
from shared.exceptions import RunError
from tools.fleet.supervise import SupervisedFleet
from tools.number_arguments import natural
from tools.runs.experiment import load_robot
from tools.runs.recorded_robot import robot_of
from tools.runs.run_index import RunIndex
from tools.runs.run_parts import add_part, read_asked
from tools.verb_table import RUN_HELP, Subparsers, add_config, add_run_dir, add_verb
from tools.view.live import LiveSource
from tools.view.lockstep import LockstepSource
from tools.view.record import RecordSource
from tools.view.server import PORT, ViewServer
from tools.view.source import Source


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "view",
        """
        xrl view                       # the fleet that is up: look, and touch nothing
        xrl view out/demo/run.mcap     # a record: play, pause, step, scrub
        xrl view --sim                 # a robot in this process: lead it, push it, kill its planner
        """,
    )
    parser.add_argument("record", nargs="?", type=Path, metavar="RUN", help=RUN_HELP)
    parser.add_argument("--sim", action="store_true", help="a robot of its own, in virtual time")
    parser.add_argument(
        "--port", type=natural, default=PORT, help="of 127.0.0.1 (default: %(default)s); 0: any"
    )
    add_part(parser)
    add_config(parser)
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    if args.port > 65_535:
        raise RunError(f"--port {args.port}: up to 65535 is right")
    if args.sim and args.record is not None:
        raise RunError("a record and --sim do not go together; leave one out")
    with _source(args) as source:
        asyncio.run(_serve(source, args.port))
    return 0


async def _serve(source: Source, port: int) -> None:
    server = ViewServer(source, port)
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    async with server.running():
        Console().print(f"{server.address}  (Ctrl-C ends it)", soft_wrap=True)
        await ended.wait()


@contextlib.contextmanager
def _source(args: argparse.Namespace) -> Iterator[Source]:
    if args.sim:
        lockstep = LockstepSource(load_robot(args.config))
        try:
            yield lockstep
        finally:
            lockstep.close()
    elif args.record is not None:
        log = read_asked(args, RunIndex(args.record))
        yield RecordSource(log, robot_of(log))
    else:
        fleet = SupervisedFleet.attach(args.run_dir)
        live = LiveSource(config_file.load(Path(fleet.manifest.config)), fleet.run.path)
        try:
            yield live
        finally:
            live.disconnect()
