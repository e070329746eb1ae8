"""`xrl estop`: every module to DAMP, now, by shared memory and over the bus."""

from __future__ import annotations

import argparse
import getpass
import sys
import time
from pathlib import Path

from rich.console import Console

from services.joint.neighbours import Neighbours
from services.joint.rearm_guard import ask_stop
from shared.bus import topics
from shared.bus.messages import Estop, JointState, Mode
from shared.bus.session import open_session
from shared.clock import now_ns
from shared.config.files import load
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, XrlError
from shared.robot.joints import MODULES
from tools.supervision.supervise import SupervisedFleet
from tools.verbs import Subparsers, add_run_dir, add_verb

REPEAT_S = 0.05
"""The bus may drop a message: it is said again until all six have heard."""
GIVE_UP_S = 3.0
STOPPED = (Mode.DAMP, Mode.FAULT)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "estop",
        """
        xrl estop
        xrl estop --run-dir /tmp/lab
        xrl estop --local       # on the robot's own host: needs no bus
        """,
    )
    add_run_dir(parser)
    parser.add_argument(
        "--local",
        action="store_true",
        help="by shared memory alone, to the joint services on this host; without it by both ways",
    )


def run(args: argparse.Namespace) -> int:
    """Say it until every module is stopped; a module leaves DAMP by a restart only."""
    run_dir: Path = args.run_dir
    here = ask_here(run_dir)  # first: it needs no bus, no supervisor, nobody
    if args.local:
        if not here:
            raise FleetError(f"{run_dir}: no joint service of a fleet is on this host")
        going = wait_here(run_dir, here)
    else:
        try:
            fleet = SupervisedFleet.attach(run_dir)
            going = _say(load(Path(fleet.manifest.config)), run_dir)
        except XrlError as error:
            if not here:
                raise
            print(f"xrl: not over the bus: {error}", file=sys.stderr)
            going = wait_here(run_dir, here)
    if going:
        raise FleetError(f"not stopped after {GIVE_UP_S:g} s: {', '.join(going)}; cut the power")
    Console().print(
        "all six modules are stopped: DAMP. It sinks slowly, or holds beside a limp or dead "
        "module; `xrl down` ends it"
    )
    return 0


def ask_here(run_dir: Path) -> list[str]:
    """Ask the services on this host by shared memory; return those that are there."""
    here = []
    for module in MODULES:
        try:
            if ask_stop(run_dir, module):
                here.append(module)
        except OSError as error:
            print(f"xrl: {module} cannot be asked: {error.strerror}", file=sys.stderr)
    return here


def _is_stopped(run_dir: Path, module: str) -> bool:
    return Neighbours.mode_of(run_dir, module) in STOPPED


def wait_here(run_dir: Path, here: list[str]) -> list[str]:
    """Wait for the services on this host; return in words what has not stopped.

    Args:
        run_dir: of the fleet.
        here: the modules that have a service on this host.
    """
    deadline = time.monotonic() + GIVE_UP_S
    while time.monotonic() < deadline and not all(_is_stopped(run_dir, m) for m in here):
        time.sleep(REPEAT_S)
    going = [module for module in here if not _is_stopped(run_dir, module)]
    return going + [f"{m} has no service on this host" for m in MODULES if m not in here]


def _say(robot: RobotConfig, run_dir: Path) -> list[str]:
    """Say it on the bus until all have stopped, as heard or seen; return what has not."""
    source = f"xrl estop by {getpass.getuser()}"
    modes: dict[str, int] = {}
    with open_session(robot, "estop", run_dir) as session:
        publisher = session.publisher(topics.ESTOP, Estop)
        states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        seq, deadline, going = 0, time.monotonic() + GIVE_UP_S, list(MODULES)
        while going and time.monotonic() < deadline:
            seq += 1
            publisher.put(Estop(t_ns=now_ns(), seq=seq, source=source))
            time.sleep(REPEAT_S)
            for module, latest in states.items():
                state = latest.take()
                if state is not None:
                    modes[module] = state.mode
            going = [
                m for m in going if modes.get(m) not in STOPPED and not _is_stopped(run_dir, m)
            ]
    return [f"{m} {Mode(modes[m]).name if m in modes else 'silent'}" for m in going]
