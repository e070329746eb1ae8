"""When the planner leads and when it asks all six modules to hold (design section 4).

All six track or none does: while one module's state is stale, or one is not in TRACK,
every command carries `hold`, so that no leg works against the other. Modules tell
`ready` once fresh commands have come for long enough; when all are ready, `hold` is
lifted for all in the same tick. Pure: state, inputs -> outputs.
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

    def advance(self, now_ns: int, fresh: list[bool], ready: list[bool], modes: list[int]) -> bool:
        """Take the six modules' news; return True if the mode changed.

        Args:
            now_ns: the planner's clock.
            fresh: per module, a state has come within `planner.state_stale_ms`.
            ready: per module, `JointState.ready`.
            modes: per module, `JointState.mode`.
        """
        after = self._next(now_ns, fresh, ready, modes)
        changed = after is not self.mode
        if changed:
            self.mode, self.since_ns = after, now_ns
        return changed

    def _next(
        self, now_ns: int, fresh: list[bool], ready: list[bool], modes: list[int]
    ) -> PlannerMode:
        if not all(fresh):
            return PlannerMode.WAITING
        if self.mode is PlannerMode.WAITING:
            return PlannerMode.ALIGNING
        if self.mode is PlannerMode.ALIGNING:
            return PlannerMode.LEADING if all(ready) else PlannerMode.ALIGNING
        settled = now_ns - self.since_ns > GRACE_NS
        if settled and any(mode != Mode.TRACK for mode in modes):
            return PlannerMode.ALIGNING
        return PlannerMode.LEADING

    @property
    def hold(self) -> bool:
        """True if every command is to carry `hold`."""
        return self.mode is not PlannerMode.LEADING
