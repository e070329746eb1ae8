"""`xrl assist`: ask the robot to carry some of the person, for as long as the verb runs."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

from rich.live import Live
from rich.text import Text

from shared.bus import topics
from shared.bus.messages import STRAIGHT, OperatorIntent, PlannerMode, PlannerStatus, Vector4
from shared.bus.session import open_session
from shared.clock import now_ns
from shared.config.files import load
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError
from shared.process import StopFlag
from shared.user import user_name
from tools.fleet.supervise import SupervisedFleet
from tools.number_arguments import finite, finite_numbers
from tools.terminal import Console
from tools.verb_table import Subparsers, add_run_dir, add_verb

REPEAT_S: Final = 0.02
HEARD_S: Final = 3.0
"""Longest wait for the planner, and for it to accept the request, s."""
SHIFT_UNITS: Final = (("x", "m"), ("y", "m"), ("roll", "rad"), ("yaw", "rad"))


Stop = Callable[[], bool]


class IntentClient(Protocol):
    """The way to the planner."""

    def put(self, message: OperatorIntent) -> bool:
        """Send without waiting."""


class Statuses(Protocol):
    """The way back."""

    def take(self) -> PlannerStatus | None:
        """Return the newest status since the last call, or None."""


class Shown(Protocol):
    """Where it is shown how much is given."""

    def update(self, renderable: Text) -> None:
        """Show a line in place of the last."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "assist",
        """
        xrl assist 80                     # N, until Ctrl-C; then it fades out
        xrl assist 80 --for 60            # for a minute
        xrl assist 0 --shift 0.02,0,0,0   # lean the COM 2 cm forwards
        """,
    )
    add_run_dir(parser)
    parser.add_argument("assist", type=finite, metavar="N", help="upward force on the person, N")
    parser.add_argument(
        "--shift",
        type=_shift,
        default=STRAIGHT,
        metavar="X,Y,ROLL,YAW",
        help="where COM (m) and torso (rad) are to be off a straight stand (0,0,0,0)",
    )
    parser.add_argument(
        "--for", dest="for_s", type=finite, metavar="S", help="seconds (default: until Ctrl-C)"
    )


def run(args: argparse.Namespace) -> int:
    """Publish the request until stopped."""
    fleet = SupervisedFleet.attach(args.run_dir)
    robot = load(Path(fleet.manifest.config))
    refuse_beyond_limits(robot, args.assist, args.shift)
    if args.for_s is not None and not args.for_s > 0.0:
        raise FleetError(f"--for {args.for_s:g}: a time is right, such as 60")
    stop = StopFlag()
    source = f"xrl assist by {user_name()} ({os.getpid()})"
    with open_session(robot, "assist", args.run_dir) as session:
        intents = session.publisher(topics.OPERATOR_INTENT, OperatorIntent)
        statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        with Live(console=Console(), refresh_per_second=4, transient=True) as shown:
            request = OperatorIntent(
                t_ns=now_ns(), seq=0, assist_n=args.assist, shift=args.shift, source=source
            )
            given = ask(intents, statuses, request, lambda: bool(stop), shown, for_s=args.for_s)
    fade_s = robot.assist.fade_s
    Console().print(f"request ended: {given:.0f} N were given; they fade out in {fade_s:g} s")
    return 0


def refuse_beyond_limits(robot: RobotConfig, assist: float, shift: Vector4) -> None:
    """Refuse a request that the planner would limit.

    Raises:
        FleetError: the assist or a part of the shift is beyond the robot file's limit.
    """
    most = robot.assist.force_max
    if not 0.0 <= assist <= most:
        raise FleetError(f"{assist:g} N: 0 to {most:g} N can be requested (assist.force_max)")
    for (name, unit), asked, limit in zip(SHIFT_UNITS, shift, robot.law.shift_max, strict=True):
        if not abs(asked) <= limit:
            raise FleetError(
                f"--shift: {name} {asked:g} {unit}: -{limit:g} to {limit:g} {unit} can be asked "
                "for (law.shift_max)"
            )


def ask(
    intents: IntentClient,
    statuses: Statuses,
    request: OperatorIntent,
    stop: Stop,
    shown: Shown,
    *,
    for_s: float | None = None,
) -> float:
    """Publish the request repeatedly; return the assist given at the end, N.

    Args:
        intents: to the planner.
        statuses: from it.
        request: the request; stamp and number are set at each repetition.
        stop: True ends it.
        shown: shows the assist given.
        for_s: duration, s; None: until stopped.

    Raises:
        FleetError: the planner is silent, another operator has a request, or the planner accepts
            none.
    """
    status = _first(statuses, stop)
    if status is None:
        return 0.0
    if status.requested_by not in ("", SCENARIO):
        raise FleetError(f"{status.requested_by} asks already; end that first")
    start = received_at = time.monotonic()
    while not stop() and (for_s is None or time.monotonic() - start < for_s):
        now = time.monotonic()
        intents.put(
            OperatorIntent(
                t_ns=now_ns(),
                seq=round((now - start) / REPEAT_S),
                assist_n=request.assist_n,
                shift=request.shift,
                source=request.source,
            )
        )
        newest = statuses.take()
        if newest is not None:
            status = newest
            shown.update(Text(describe(request, status)))
            if status.requested_by == request.source:
                received_at = now
        if now - received_at > HEARD_S:
            taken = (
                f"it follows {status.requested_by}" if status.requested_by else "see `xrl status`"
            )
            raise FleetError(f"the planner does not take what is asked; {taken}")
        time.sleep(REPEAT_S)
    return status.assist_n


def describe(request: OperatorIntent, status: PlannerStatus) -> str:
    """Return request and response as one line."""
    words = f"requested {request.assist_n:.0f} N, given {status.assist_n:.0f} N"
    if any(request.shift):
        pairs = zip(SHIFT_UNITS, request.shift, strict=True)
        words += ", shift " + ", ".join(f"{name} {at:g} {unit}" for (name, unit), at in pairs if at)
    mode = PlannerMode(status.mode)
    if mode is not PlannerMode.LEADING:
        words += f"; {mode.name}: {status.why or 'it does not lead'}"
    return words + " - Ctrl-C ends it"


def _first(statuses: Statuses, stop: Stop) -> PlannerStatus | None:
    deadline = time.monotonic() + HEARD_S
    while not stop():
        status = statuses.take()
        if status is not None:
            return status
        if time.monotonic() > deadline:
            raise FleetError("the planner is silent; see `xrl status`")
        time.sleep(REPEAT_S)
    return None


def _shift(text: str) -> Vector4:
    try:
        x, y, roll, yaw = finite_numbers(text, 4)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}; such as 0.02,0,0,0") from None
    return x, y, roll, yaw
