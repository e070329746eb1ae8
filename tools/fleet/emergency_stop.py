"""Emergency stop: through shared memory on this host, and over the bus to all six modules."""

from __future__ import annotations

import platform
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from services.joint.neighbours import Neighbours
from services.joint.rearm_guard import request_stop
from shared.bus import topics
from shared.bus.credentials import read_credentials
from shared.bus.messages import Estop, JointState, Mode, name_of
from shared.bus.session import Session, open_session
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.places import user_name
from tools.fleet import procfs

REPEAT_S: Final = 0.05
"""Period of the stop message, s. The bus may drop a message, so it is repeated until all six
modules have stopped."""
GIVE_UP_S: Final = 3.0
UNHEARD_S: Final = 0.5
"""A module is silent if its last state is older than this, s."""
STOPPED: Final = (Mode.DAMP, Mode.FAULT)


def request_here(run_dir: Path) -> tuple[list[str], list[str]]:
    """Request a stop through shared memory from the services on this host.

    A service whose shared-memory file is gone, for example with its disk, receives SIGUSR1.

    Returns:
        The modules that received the request, and a line for each that did not or cannot confirm
        it.
    """
    here, errors = [], []
    processes: dict[str, int] | None = None
    for module in MODULES:
        try:
            if request_stop(run_dir, module, _source()):
                here.append(module)
                continue
        except OSError as error:
            errors.append(f"{module}: no stop through shared memory: {error.strerror}")
        processes = procfs.service_pids(run_dir) if processes is None else processes
        if module in processes:
            procfs.signal_all([processes[module]], signal.SIGUSR1)
            errors.append(
                f"{module}: its shared memory is gone: stop requested with SIGUSR1, unconfirmed"
            )
    return here, errors


def wait_here(run_dir: Path, here: list[str], wanted: Sequence[str] = MODULES) -> list[str]:
    """Wait until this host's modules have stopped; return those that have not or are missing."""
    deadline, going = time.monotonic() + GIVE_UP_S, list(here)
    while going and time.monotonic() < deadline:
        # a stopped module stays stopped; it is not read again, since its row might be half written
        going = [module for module in going if not _is_stopped(run_dir, module)]
        if going:
            time.sleep(REPEAT_S)
    absent = [module for module in wanted if module not in here]
    return going + [f"{module} has no service on this host" for module in absent]


class BusStop:
    """The stop over the bus, on an open session, so that stopping needs no new connection."""

    def __init__(self, robot: RobotConfig, session: Session, here: Path | None) -> None:
        """Subscribe; `here` is the run directory of this robot's services on this host, or None."""
        self._robot, self._here = robot, here
        self._publisher = session.publisher(topics.ESTOP, Estop)
        self._states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        self._modes: dict[str, int] = {}
        self._heard_s: dict[str, float] = {}
        self._seq = 0

    def listen(self) -> list[str]:
        """Receive the modules' states; return the silent modules."""
        now_s = time.monotonic()
        for module, latest in self._states.items():
            state = latest.take()
            if state is not None:
                self._modes[module], self._heard_s[module] = state.mode, now_s
        return [m for m in MODULES if now_s - self._heard_s.get(m, -UNHEARD_S) >= UNHEARD_S]

    def stop(self) -> list[str]:
        """Publish the stop until all six modules have stopped; return those that have not in time.

        Earlier states do not count, because a module may have become silent since.
        """
        self.listen()
        self._modes.clear()
        deadline, going = time.monotonic() + GIVE_UP_S, list(MODULES)
        while going and time.monotonic() < deadline:
            self._seq += 1
            self._publisher.put(Estop(t_ns=now_ns(), seq=self._seq, source=_source()))
            time.sleep(REPEAT_S)
            self.listen()
            going = [module for module in going if not self._has_stopped(module)]
        modes = {module: name_of(Mode, mode) for module, mode in self._modes.items()}
        failed = [f"{module} {modes.get(module, 'silent')}" for module in going]
        if failed and self._robot.bus.security.mode == "mtls":
            name = read_credentials(self._robot, "estop").name
            failed += [] if name == topics.OPERATOR else [f"this host has only the key of a {name}"]
        return failed

    def _has_stopped(self, module: str) -> bool:
        by_memory = self._here is not None and _is_stopped(self._here, module)
        return by_memory or self._modes.get(module) in STOPPED


def stop_all(robot: RobotConfig, run_dir: Path, *, here: bool) -> list[str]:
    """Stop over the bus in a new session; `here`: this run directory holds the robot's services."""
    with open_session(robot, "estop", run_dir) as session:
        return BusStop(robot, session, run_dir if here else None).stop()


def refuse_going(going: list[str]) -> None:
    """Raise a FleetError that names the modules that have not stopped, if any."""
    if going:
        raise FleetError(f"not stopped after {GIVE_UP_S:g} s: {', '.join(going)}; cut the power")


def _source() -> str:
    """Return who requests the stop; never raises, because nothing may prevent a stop."""
    text = f"xrl estop by {user_name()} on {platform.node()}"
    return text.encode(errors="replace").decode()


def _is_stopped(run_dir: Path, module: str) -> bool:
    return Neighbours.mode_of(run_dir, module) in STOPPED
