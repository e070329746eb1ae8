"""A planner that leads and is asked for something: met, watched, asked (`operator/intent`)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Final

from shared.bus import topics
from shared.bus.messages import (
    STRAIGHT,
    OperatorIntent,
    PlannerMode,
    PlannerStatus,
    Vector4,
    name_of,
)
from shared.bus.session import Session
from shared.clock import NS_PER_S, now_ns
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError
from shared.user import user_name

LOOK_S: Final = 0.002
LINKS_S: Final = 3.0
"""Longest wait for the first status."""
SILENT_S: Final = 0.3
"""Longest time without a status; beyond it nobody knows what the planner does."""
LEADS_S: Final = 15.0
"""Longest wait for a planner that does not lead yet: a fleet that was just started."""


def asker(verb: str) -> str:
    """Return who asks by a verb, as `OperatorIntent.source` has it."""
    return f"xrl {verb} by {user_name()} ({os.getpid()})"


def other_asker(status: PlannerStatus | None, own: str) -> str:
    """Return who else asks the planner for something; "" for nobody but a scenario."""
    by = "" if status is None else status.requested_by
    return "" if by in (SCENARIO, own) else by


class LedPlanner:
    """The planner of a robot that is up, and its newest status."""

    def __init__(self, session: Session, verb: str) -> None:
        self._intents = session.publisher(topics.OPERATOR_INTENT, OperatorIntent)
        self._statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        self.source = asker(verb)
        self._sent = 0
        deadline = time.monotonic() + LINKS_S
        while (status := self._statuses.take()) is None:
            if time.monotonic() > deadline:
                raise FleetError("the robot is silent; see `xrl status`")
            time.sleep(LOOK_S)
        self.status, self._heard_ns = status, now_ns()
        deadline = time.monotonic() + LEADS_S
        while (why := self.trouble()) and time.monotonic() < deadline:
            time.sleep(LOOK_S)
            self.listen()
        if why:
            raise FleetError(f"{why}; see `xrl status`")

    def listen(self) -> bool:
        """Receive a newer status; return True if there was one."""
        newer = self._statuses.take()
        if newer is not None:
            self.status, self._heard_ns = newer, now_ns()
        return newer is not None

    def trouble(self) -> str:
        """Return why it cannot be asked for anything now; "" if it can."""
        status = self.status
        if now_ns() - self._heard_ns > SILENT_S * NS_PER_S:
            return "the planner is silent"
        if status.mode != PlannerMode.LEADING:
            why = f" ({status.why})" if status.why else ""
            return f"the planner does not lead: {name_of(PlannerMode, status.mode)}{why}"
        other = other_asker(status, self.source)
        return f"{other} asks the robot for something else" if other else ""

    def lead(
        self,
        duration_s: float,
        ask: Callable[[float], None],
        listen: Callable[[], None],
        stopped: Callable[[], bool],
        *,
        every_s: float,
    ) -> str:
        """Ask for what is wanted at a time, s, again and again, and listen ten times as often.

        Whatever ends it, nothing is asked for any more, and what was asked for fades out.

        Returns:
            Why it ended before its time; "" if it did not.
        """
        begin, ask_s, ended = now_ns(), 0.0, ""
        while not ended and (t_s := (now_ns() - begin) / NS_PER_S) < duration_s:
            if t_s >= ask_s:
                ask(t_s)
                ask_s = t_s + every_s
            listen()
            ended = "stopped" if stopped() else self.trouble()
            time.sleep(0.1 * every_s)
        return ended

    def ask(
        self,
        *,
        assist_n: float = 0.0,
        shift: Vector4 = STRAIGHT,
    ) -> None:
        """Ask once; what is not repeated fades out."""
        self._sent += 1
        self._intents.put(
            OperatorIntent(
                t_ns=now_ns(), seq=self._sent, assist_n=assist_n, shift=shift, source=self.source,
            )
        )  # fmt: skip
