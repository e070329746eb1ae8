"""`xrl kill`: send a signal to one service."""

from __future__ import annotations

import signal
from typing import Annotated, Final, Literal

from shared.joints import MODULES
from tools.flags import RunDirFlags, positional
from tools.fleet.supervise import SupervisedFleet

EXAMPLES: Final = """
xrl kill planner                        # dead at once; the supervisor restarts it
xrl kill planner --signal STOP          # frozen, like a hung process
xrl kill planner --signal CONT          # resumed
xrl kill knee_left                      # its drive holds; the new service takes it over
"""


class KillFlags(RunDirFlags):
    """Which service, and how."""

    service: Annotated[str, positional("SERVICE")]
    """a name that `xrl status` shows"""
    signal: Literal["KILL", "STOP", "CONT", "TERM"] = "KILL"


def run(flags: KillFlags) -> int:
    """Send the signal."""
    fleet = SupervisedFleet.attach(flags.run_dir)
    if flags.signal in ("KILL", "TERM") and flags.service in MODULES:
        fleet.forget(flags.service)  # a person asked for its next process: it may arm the drive
    pid = fleet.kill(flags.service, signal.Signals[f"SIG{flags.signal}"])
    print(f"{flags.service} (pid {pid}): {flags.signal} sent")
    return 0
