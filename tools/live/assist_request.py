"""A request for assist, repeated for as long as it is meant, and what the planner makes of it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Final

from rich.live import Live
from rich.text import Text

from shared.bus.messages import OperatorIntent, PlannerMode, PlannerStatus, Vector4
from shared.bus.session import Latest, Publisher
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError
from shared.places import user_name

REPEAT_S: Final = 0.02
HEARD_S: Final = 3.0
"""Longest wait for the planner, and for it to accept the request, s."""
SHIFT_UNITS: Final = (("x", "m"), ("y", "m"), ("roll", "rad"), ("yaw", "rad"))


Stop = Callable[[], bool]


def asker(verb: str) -> str:
    """Return the requester's name for a verb, as `OperatorIntent.source` has it."""
    return f"xrl {verb} by {user_name()} ({os.getpid()})"


def other_asker(status: PlannerStatus | None, own: str = "") -> str:
    """Return who else requests something of the planner; "" if only a scenario or nobody does."""
    by = "" if status is None else status.requested_by
    return "" if by in (SCENARIO, own) else by


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
    intents: Publisher[OperatorIntent],
    statuses: Latest[PlannerStatus],
    request: OperatorIntent,
    stop: Stop,
    shown: Live,
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
    if other := other_asker(status):
        raise FleetError(f"{other} asks already; end that first")
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


def _first(statuses: Latest[PlannerStatus], stop: Stop) -> PlannerStatus | None:
    deadline = time.monotonic() + HEARD_S
    while not stop():
        status = statuses.take()
        if status is not None:
            return status
        if time.monotonic() > deadline:
            raise FleetError("the planner is silent; see `xrl status`")
        time.sleep(REPEAT_S)
    return None
