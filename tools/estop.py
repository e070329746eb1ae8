"""`xrl estop`: every module to DAMP, now."""

from __future__ import annotations

import argparse
import getpass
import time
from pathlib import Path

from rich.console import Console

from shared import topics
from shared.bus import open_session
from shared.clock import now_ns
from shared.config_file import load
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.messages import Estop, JointState, Mode
from tools.supervision.supervise import Fleet
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
        """,
    )
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Say it until every module is stopped; a module leaves DAMP by a restart only."""
    fleet = Fleet.attach(args.run_dir)
    robot = load(Path(fleet.manifest.config))
    source = f"xrl estop by {getpass.getuser()}"
    modes: dict[str, int] = {}
    deadline = time.monotonic() + GIVE_UP_S
    with open_session(robot, "estop", args.run_dir) as session:
        publisher = session.publisher(topics.ESTOP, Estop)
        states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        seq = 0
        while time.monotonic() < deadline:
            seq += 1
            publisher.put(Estop(t_ns=now_ns(), seq=seq, source=source))
            for module, latest in states.items():
                state = latest.take()
                if state is not None:
                    modes[module] = state.mode
            if all(modes.get(module) in STOPPED for module in MODULES):
                Console().print(
                    "all six modules are stopped: DAMP, a slow sink; `xrl down` ends it"
                )
                return 0
            time.sleep(REPEAT_S)
    going = [
        f"{m} {Mode(modes[m]).name if m in modes else 'silent'}"
        for m in MODULES
        if modes.get(m) not in STOPPED
    ]
    raise FleetError(f"not stopped after {GIVE_UP_S:g} s: {', '.join(going)}; cut the power")
