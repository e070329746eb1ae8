"""`xrl drive tare`: sets a new zero for the harness sensor."""

from __future__ import annotations

import math
import time
from typing import Annotated, Final

from shared.bus import topics
from shared.bus.messages import Tare, TareRequest, Wrench
from shared.bus.ports import Inbox, Outbox
from shared.bus.session import open_session
from shared.clock import now_ns
from shared.exceptions import FleetError
from shared.places import user_name
from tools.flags import Arg, RunDirFlags
from tools.fleet.supervise import SupervisedFleet
from tools.terminal import Console

LOADED_N: Final = 30.0
"""Reading above which the harness is assumed to be loaded, N; drift is smaller."""
REPEAT_S: Final = 0.02
"""Period at which the request is repeated until the tare starts, s: the bus may drop messages."""
HEARD_S: Final = 3.0
"""Timeout for the first wrench, s."""
GIVE_UP_S: Final = 10.0

EXAMPLES: Final = """
xrl drive tare
"""


class TareFlags(RunDirFlags):
    """Permission to tare a harness that reads a load."""

    anyway: Annotated[
        bool,
        Arg(help=f"tare a drifted sensor that reads more than {LOADED_N:g} N"),
    ] = False


def run(flags: TareFlags) -> int:
    """Request the tare and wait until the wrench is valid again."""
    fleet = SupervisedFleet.attach(flags.run_dir)
    robot = fleet.manifest.robot()
    with open_session(robot, "tare", flags.run_dir) as session:
        requests = session.publisher(topics.HARNESS_TARE, TareRequest)
        wrenches = session.latest(topics.WRENCH, Wrench)
        before = tare(requests, wrenches, anyway=flags.anyway)
    read = describe(before) if before.valid else "no valid wrench"
    Console().print(
        f"the harness is tared: its present reading is zero; the old reading was {read}"
    )
    return 0


def tare(requests: Outbox[TareRequest], wrenches: Inbox[Wrench], *, anyway: bool) -> Wrench:
    """Request the tare, wait until it is done, and return the reading before it."""
    before = newest = _first(wrenches)
    if before.valid and math.hypot(*before.force) > LOADED_N and not anyway:
        raise FleetError(
            f"the harness reads {describe(before)}: unload it and try again; or use --anyway if "
            "it is unloaded and its sensor has drifted"
        )
    source = f"xrl drive tare by {user_name()}"
    begun = False
    deadline = time.monotonic() + GIVE_UP_S
    seq = 0
    while time.monotonic() < deadline:
        if not begun:
            seq += 1
            requests.put(TareRequest(t_ns=now_ns(), seq=seq, source=source))
        time.sleep(REPEAT_S)
        newest = wrenches.take() or newest
        begun = begun or newest.tare != Tare.DONE
        if begun and newest.valid:
            return before
    raise FleetError(f"not tared after {GIVE_UP_S:g} s: {_why_not(newest, begun=begun)}")


def describe(wrench: Wrench) -> str:
    """Return a wrench's magnitudes as text."""
    return f"{math.hypot(*wrench.force):.1f} N, {math.hypot(*wrench.moment):.1f} N m"


def _first(wrenches: Inbox[Wrench]) -> Wrench:
    deadline = time.monotonic() + HEARD_S
    while time.monotonic() < deadline:
        wrench = wrenches.take()
        if wrench is not None:
            return wrench
        time.sleep(REPEAT_S)
    raise FleetError("no wrench from the harness service; see `xrl status`")


def _why_not(newest: Wrench, *, begun: bool) -> str:
    if not begun:
        return "the harness service did not begin the tare; see `xrl status`"
    if newest.saturated:
        return "a load cell is at the end of its range; unload the harness"
    if newest.tare == Tare.UNSTEADY:
        return "the forces vary; keep robot and harness still, and the tare completes on its own"
    return "the load cells do not send steadily; check their bus"
