"""Emergency stop: by shared memory on this host, and over the bus to all six modules."""

from __future__ import annotations

import getpass
import os
import platform
import time
from pathlib import Path
from typing import Final

from services.joint.neighbours import Neighbours
from services.joint.rearm_guard import request_stop
from shared.bus import topics
from shared.bus.credentials import read_credentials
from shared.bus.messages import Estop, JointState, Mode
from shared.bus.session import open_session
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.robot.joints import MODULES

REPEAT_S: Final = 0.05
"""The bus may drop a message: the stop is repeated until all six have stopped."""
GIVE_UP_S: Final = 3.0
STOPPED: Final = (Mode.DAMP, Mode.FAULT)


def request_here(run_dir: Path) -> tuple[list[str], list[str]]:
    """Request a stop by shared memory from the services on this host.

    Returns:
        The modules that received it, and one line for each that could not.
    """
    here, errors = [], []
    for module in MODULES:
        try:
            if request_stop(run_dir, module, _source()):
                here.append(module)
        except OSError as error:
            errors.append(f"{module}: no stop by shared memory: {error.strerror}")
    return here, errors


def wait_here(run_dir: Path, here: list[str], *, partly: bool = False) -> list[str]:
    """Wait until the services on this host have stopped.

    Args:
        run_dir: of the fleet.
        here: the modules that have a service on this host.
        partly: the others have theirs on other hosts, and are not asked after.

    Returns:
        One line for each module that has not stopped, or has no service here.
    """
    deadline = time.monotonic() + GIVE_UP_S
    while time.monotonic() < deadline and not all(_is_stopped(run_dir, m) for m in here):
        time.sleep(REPEAT_S)
    going = [module for module in here if not _is_stopped(run_dir, module)]
    absent = [] if partly else [module for module in MODULES if module not in here]
    return going + [f"{module} has no service on this host" for module in absent]


def stop_all(robot: RobotConfig, run_dir: Path) -> list[str]:
    """Publish the stop until all six modules have stopped.

    Returns:
        Each module that has not stopped, with its mode.

    Raises:
        BusError: the bus cannot be opened.
    """
    modes: dict[str, int] = {}
    with open_session(robot, "estop", run_dir) as session:
        publisher = session.publisher(topics.ESTOP, Estop)
        states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        seq, deadline, going = 0, time.monotonic() + GIVE_UP_S, list(MODULES)
        while going and time.monotonic() < deadline:
            seq += 1
            publisher.put(Estop(t_ns=now_ns(), seq=seq, source=_source()))
            time.sleep(REPEAT_S)
            for module, latest in states.items():
                state = latest.take()
                if state is not None:
                    modes[module] = state.mode
            going = [
                m for m in going if modes.get(m) not in STOPPED and not _is_stopped(run_dir, m)
            ]
    going = [f"{m} {Mode(modes[m]).name if m in modes else 'silent'}" for m in going]
    if going and robot.bus.security.mode == "mtls":
        name = read_credentials(robot, "estop").name
        going += [] if name == topics.OPERATOR else [f"this host has the key of a {name} only"]
    return going


def _source() -> str:
    """Return who asks for the stop; never raises, for nothing may keep a stop from going out."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in a container
        user = f"uid {os.getuid()}"
    text = f"xrl estop by {user} on {platform.node()}"
    return text.encode(errors="replace").decode()


def _is_stopped(run_dir: Path, module: str) -> bool:
    return Neighbours.mode_of(run_dir, module) in STOPPED
