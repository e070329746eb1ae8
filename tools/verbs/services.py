"""`xrl kill`, `xrl start` and `xrl rearm`: signal, start and rearm services."""

from __future__ import annotations

import signal
from typing import Annotated, Final, Literal

from shared.exceptions import FAULT_EXIT_CODE
from shared.joints import MODULES
from tools.flags import RunDirFlags, positional
from tools.fleet.rearming import rearm as rearm_all
from tools.fleet.supervise import SupervisedFleet

EXAMPLES: Final = """
xrl start planner       # after `xrl up --no-planner`: it leads once all six modules are ready
xrl start knee_left     # at once, even while the supervisor delays a restart
xrl kill planner                        # the supervisor restarts it
xrl kill planner --signal STOP          # freeze it, like a hung process
xrl kill planner --signal CONT
xrl kill knee_left                      # its drive holds until the new service takes over
xrl rearm               # once the robot is at rest: all six hold, then the planner leads
"""


class ServiceFlags(RunDirFlags):
    """Service to act on."""

    service: Annotated[str, positional("SERVICE")]
    """service, as in `xrl status`"""


class KillFlags(ServiceFlags):
    """Signal to send."""

    signal: Literal["KILL", "STOP", "CONT", "TERM"] = "KILL"
    """signal to send"""


def start(flags: ServiceFlags) -> int:
    """Start or resume a service."""
    fleet = SupervisedFleet.attach(flags.run_dir)
    crash_loop = fleet.crash_loop(flags.service)
    runs = fleet.start_service(flags.service)
    if crash_loop:
        print(f"{crash_loop}. {'Nothing was done' if runs is not None else 'Started again'}")
        return FAULT_EXIT_CODE
    if runs is not None:
        print(f"{flags.service}: already runs as process {runs}; nothing was done")
    else:
        print(f"{flags.service}: started; `xrl status` shows its state")
    return 0


def kill(flags: KillFlags) -> int:
    """Send the signal."""
    fleet = SupervisedFleet.attach(flags.run_dir)
    if flags.signal in ("KILL", "TERM") and flags.service in MODULES:
        fleet.forget(flags.service)  # a person requests the next process, so it may arm the drive
    pid = fleet.kill(flags.service, signal.Signals[f"SIG{flags.signal}"])
    print(f"{flags.service} (pid {pid}): {flags.signal} sent")
    return 0


def rearm(flags: RunDirFlags) -> int:
    """End an emergency stop for all six modules together, or for none."""
    taken_s = rearm_all(SupervisedFleet.attach(flags.run_dir))
    print(f"all six modules hold or track again after {taken_s:.1f} s; the planner leads next")
    return 0
