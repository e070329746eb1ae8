"""`xrl pendant`: a dead man's handle; once it ends, in whatever way, this host's modules stop."""

from __future__ import annotations

import signal
import time
from typing import Annotated, Final

from services.joint.rearm_guard import Pendant
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.process import StopFlag
from tools.flags import Duration, RunDirFlags, option
from tools.fleet.emergency_stop import refuse_going, request_here, wait_here
from tools.keyboard import typed_line
from tools.terminal import Console

EVERY_S: Final = 0.02
OTHER_S: Final = 0.2
"""Wait in which another pendant's beats would show, s."""


EXAMPLES: Final = """
xrl pendant               # Enter lays it down without a stop; Ctrl-C stops every module
xrl pendant --for 600     # lays itself down after ten minutes
"""


class PendantFlags(RunDirFlags):
    """How long."""

    for_s: Annotated[Duration | None, option("--for")] = None
    """lay it down after S seconds"""


def run(flags: PendantFlags) -> int:
    """Beat until it is laid down; 0 then, and after a stop that reached this host's modules."""
    try:
        pendant = Pendant(flags.run_dir, MODULES)
    except OSError as error:
        raise FleetError(
            f"{flags.run_dir}: no shared memory for the pendant: {error.strerror}"
        ) from None
    if not pendant.modules:
        raise FleetError(f"{flags.run_dir}: no joint service of a fleet is on this host")
    before = pendant.beats
    time.sleep(OTHER_S)
    if pendant.beats != before:
        raise FleetError("another pendant is held: lay that one down first")
    console, stop = Console(), StopFlag(signal.SIGHUP)
    elsewhere = [module for module in MODULES if module not in pendant.modules]
    if elsewhere:
        console.print(f"does not stop {', '.join(elsewhere)}: they have no service on this host")
    console.print("held: Enter lays it down; Ctrl-C, or this program's end, stops all modules")
    ends = None if flags.for_s is None else time.monotonic() + flags.for_s
    shown = None
    while not stop and shown != "":
        pendant.beat()
        shown = typed_line(EVERY_S)
        if shown or (ends is not None and time.monotonic() >= ends):
            pendant.lay_down()
            console.print("laid down: the robot continues without it")
            return 0
    request_here(flags.run_dir)  # faster than the pendant's silence
    refuse_going(wait_here(flags.run_dir, list(pendant.modules), pendant.modules))
    console.print(
        "stopped: DAMP. It sinks slowly, or holds beside a limp or dead module; `xrl rearm` or "
        "`xrl down` ends it"
    )
    return 0
