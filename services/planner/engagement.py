"""When the planner leads and when it asks all six modules to hold (design section 4).

All six track or none does: while one module's state is stale, or one is not in TRACK,
every command carries `hold`, so that no leg works against the other. Modules tell
`ready` once fresh commands have come for long enough; when all are ready, `hold` is
lifted for all in the same tick. An overload at the harness and gains that would not stand
alone ask for `hold` too. Pure: state, inputs -> outputs.
"""

from __future__ import annotations

import msgspec

from shared.messages import Mode, PlannerMode

GRACE_NS = 150_000_000
"""After lifting `hold`, modules may take this long to report TRACK."""


class Engagement(msgspec.Struct):
    """Where the engagement stands."""

    mode: PlannerMode = PlannerMode.WAITING
    since_ns: int = 0
    """When the mode was entered."""

    def advance(
        self,
        now_ns: int,
        fresh: list[bool],
        ready: list[bool],
        modes: list[int],
        forbidden: PlannerMode | None = None,
    ) -> bool:
        """Take the six modules' news; return True if the mode changed.

        Args:
            now_ns: the planner's clock.
            fresh: per module, a state has come within `planner.state_stale_ms`.
            ready: per module, `JointState.ready`.
            modes: per module, `JointState.mode`.
            forbidden: OVERLOADED or UNCERTIFIED while the planner may not lead.
        """
        after = self._next(now_ns, fresh, ready, modes, forbidden)
        changed = after is not self.mode
        if changed:
            self.mode, self.since_ns = after, now_ns
        return changed

    def _next(
        self,
        now_ns: int,
        fresh: list[bool],
        ready: list[bool],
        modes: list[int],
        forbidden: PlannerMode | None,
    ) -> PlannerMode:
        if not all(fresh):
            return PlannerMode.WAITING
        if forbidden is not None:
            return forbidden
        if self.mode is PlannerMode.LEADING:
            settled = now_ns - self.since_ns > GRACE_NS
            lost = settled and any(mode != Mode.TRACK for mode in modes)
            return PlannerMode.ALIGNING if lost else PlannerMode.LEADING
        if self.mode is PlannerMode.ALIGNING and all(ready):
            return PlannerMode.LEADING
        return PlannerMode.ALIGNING

    @property
    def hold(self) -> bool:
        """True if every command is to carry `hold`."""
        return self.mode is not PlannerMode.LEADING
