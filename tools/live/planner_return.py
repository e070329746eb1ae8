"""What a planner that was started again waits for before it leads, for the status line."""

from __future__ import annotations

from collections.abc import Collection

from shared.bus.messages import Mode, PlannerMode, PlannerStatus, name_of
from shared.bus.ports import Inbox
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.joints import MODULES


class PlannerReturn:
    """Follows the planner's status from its start until all six modules track."""

    def __init__(self, latest: Inbox[PlannerStatus]) -> None:
        self.latest = latest
        self._since: SimTruth | None = None
        self._status: PlannerStatus | None = None

    def start(self, truth: SimTruth | None) -> None:
        """Note that the planner was started again, at the newest state of the world."""
        self._since, self._status = truth, None

    def waits(self, truth: SimTruth, modes: Collection[int]) -> str:
        """Return what the planner waits for and how long it has; empty if it leads.

        Args:
            truth: newest state of the world.
            modes: of the modules that are heard.
        """
        if self._since is None:
            return ""
        if list(modes).count(Mode.TRACK) == len(MODULES):
            self._since = None
            return ""
        status = self.latest.take()
        if status is not None and status.t_ns > self._since.t_ns:
            self._status = status
        time = f"for {(truth.t_ns - self._since.t_ns) / NS_PER_S:.1f} s"
        if self._status is None:
            return f"starting {time}"
        why = self._status.why
        if not why and self._status.wait_s:
            why = f"{self._status.wait_s:.1f} s more after drop-outs"
        return f"{name_of(PlannerMode, self._status.mode)} {time}{': ' if why else ''}{why}"
