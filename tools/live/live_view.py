"""Display of a live run: one line that is updated."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Protocol

from rich.text import Text

from shared.bus.messages import PlannerStatus
from shared.bus.traces import SimTruth
from shared.config.scenarios import Inject
from shared.robot.trip_table import reason_of
from tools.guarded_streams import printable
from tools.live.scenario_runner import LiveSnapshot
from tools.terminal import Console, renewed

PERIOD_S = 0.1
PLAIN_PERIOD_S = 1.0
UNHEARD_S = 0.5
"""Age from which a planner status is not shown, s."""


class _PlannerNews(Protocol):
    """Source of the planner's newest status (`shared.bus.session.Latest`)."""

    def take(self) -> PlannerStatus | None:
        """Return the newest message if it was not returned before, else None."""


class LiveView:
    """A line that is updated in a terminal, or printed once a second to a file."""

    def __init__(
        self, console: Console, injects: Sequence[Inject] = (), planner: _PlannerNews | None = None
    ) -> None:
        self._injects = injects
        self._planner = planner
        self._status: PlannerStatus | None = None
        self._heard_s = 0.0
        self._period_s = PERIOD_S if console.is_terminal else PLAIN_PERIOD_S
        self._next_s = 0.0
        self._renewed = renewed(console, transient=True)

    def __enter__(self) -> LiveView:
        """Start the display."""
        self._print = self._renewed.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        """End the display and remove the line."""
        self._renewed.__exit__(*error)

    def show(self, snapshot: LiveSnapshot) -> None:
        """Show the present state of the run, at most once per period."""
        now = time.monotonic()
        if now < self._next_s or snapshot.truth is None:
            return
        self._next_s = now + self._period_s
        status = self._hear(now)
        words = [snapshot.note, active(self._injects, snapshot.truth.scenario_s)]
        if snapshot.truth.hoist == 0.0:  # while the robot hangs, the planner only reports that
            words += said_by(status)
        note = "; ".join(word for word in words if word)
        self._print(Text(_line(snapshot.truth, snapshot.modes, note)))

    def _hear(self, now_s: float) -> PlannerStatus | None:
        status = None if self._planner is None else self._planner.take()
        if status is not None:
            self._status, self._heard_s = status, now_s
        return self._status if now_s - self._heard_s < UNHEARD_S else None


def active(injects: Sequence[Inject], scenario_s: float) -> str:
    """Return a scenario's impairments at a time as text; empty if none."""
    found = [row for row in injects if row.at <= scenario_s < row.until]
    return ", ".join(f"{row.link} {row.describe()}" for row in found)


def said_by(planner: PlannerStatus | None) -> tuple[str, str]:
    """Return why the planner does not lead, and when it leads again after dropouts, as text."""
    if planner is None:
        return "", ""
    why = printable(reason_of(planner))
    if planner.wait_s <= 0.0:
        return why, ""
    soon = planner.wait_s < 1.0
    return why, "leads again soon" if soon else f"leads again in {planner.wait_s:.0f} s"


def _line(truth: SimTruth, modes: Sequence[str], note: str) -> str:
    clock = f"{truth.scenario_s:6.2f} s" if truth.scenario_s >= 0.0 else "   --  s"
    x, y = (1e3 * part for part in truth.over)
    return (
        f"{clock}  height {truth.torso[2]:.3f} m  COM {x:+5.1f} {y:+5.1f} mm  "
        f"hand {truth.operator_force[2]:+6.1f} N  modes {''.join(modes)}  {note}"
    )
