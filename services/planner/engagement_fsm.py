"""When the planner leads and when it asks all six modules to hold (docs/architecture.md#age-rule).

All six track or none does: while one module's state is stale, or one is not in TRACK,
every command carries `hold`, so that no leg works against the other. Modules tell
`ready` once fresh commands have come for long enough; when all are ready, `hold` is
lifted for all in the same tick. An overload at the harness and gains that would not stand
alone ask for `hold` too.

After a drop-out of any module the planner waits before it leads again, the longer the more
there were: six links that take turns at dropping out flap as one. Pure: state, inputs ->
outputs.
"""

from __future__ import annotations

from typing import Final

import msgspec

from shared.clock import NS_PER_S
from shared.messages import Mode, PlannerMode

GRACE_NS = 150_000_000
"""After lifting `hold`, modules may take this long to report TRACK."""
WAITS_NS: Final = tuple(round(s * NS_PER_S) for s in (0.0, 0.5, 1.5, 4.0, 10.0, 20.0, 30.0))
"""From a drop-out to leading again at the earliest, by how many are remembered. With these and
`FORGET_NS` no network whatever makes more than six drop-outs in a minute. The first is cheap: a
stall of the machine is not to hold the person up."""
FORGET_NS: Final = 25 * NS_PER_S
"""Of leading without a drop-out make one forgotten. With 20 s seven would fit into a minute."""

_GONE: Final = (Mode.FAULT, Mode.DAMP)
"""No module comes from these to TRACK: there is nothing to wait for."""


class Engagement(msgspec.Struct):
    """Where the engagement stands."""

    mode: PlannerMode = PlannerMode.WAITING
    since_ns: int = 0
    """When the mode was entered."""
    dropouts: int = 0
    """Times that leading was lost and that are not yet forgotten; an index of `WAITS_NS`."""
    dropped_ns: int = 0
    """When it was lost last."""
    steady_since_ns: int = 0
    """Since when it has been led without losing or forgetting one."""

    def advance(
        self,
        now_ns: int,
        fresh: list[bool],
        ready: list[bool],
        modes: list[int],
        inhibit: PlannerMode | None = None,
    ) -> bool:
        """Take the six modules' news; return True if the mode changed.

        Args:
            now_ns: the planner's clock.
            fresh: per module, a state has come within `planner.state_stale_ms`.
            ready: per module, `JointState.ready`.
            modes: per module, `JointState.mode`.
            inhibit: why the planner may not lead, OVERLOADED and so on; None: it may.
        """
        after = self._next(now_ns, fresh, ready, modes, inhibit)
        self._count_dropouts(now_ns, after)
        changed = after is not self.mode
        if changed:
            self.mode, self.since_ns = after, now_ns
        return changed

    def wait_ns(self, now_ns: int) -> int:
        """Return how long it does not lead yet because of drop-outs, ns; 0 if it may."""
        return max(0, self.dropped_ns + WAITS_NS[self.dropouts] - now_ns)

    def _next(
        self,
        now_ns: int,
        fresh: list[bool],
        ready: list[bool],
        modes: list[int],
        inhibit: PlannerMode | None,
    ) -> PlannerMode:
        if not all(fresh):
            return PlannerMode.WAITING
        if inhibit is not None:
            return inhibit
        if self.mode is PlannerMode.LEADING:
            settled = now_ns - self.since_ns > GRACE_NS
            lost = any(mode in _GONE or (settled and mode != Mode.TRACK) for mode in modes)
            return PlannerMode.ALIGNING if lost else PlannerMode.LEADING
        if self.mode is PlannerMode.ALIGNING and not self.wait_ns(now_ns) and all(ready):
            return PlannerMode.LEADING
        return PlannerMode.ALIGNING

    def _count_dropouts(self, now_ns: int, after: PlannerMode) -> None:
        """Count what is lost, and forget one after a good time; `after` is the next mode."""
        if self.mode is not PlannerMode.LEADING:
            self.steady_since_ns = now_ns
        elif after in (PlannerMode.WAITING, PlannerMode.ALIGNING, PlannerMode.TRIPPED):
            self.dropouts = min(self.dropouts + 1, len(WAITS_NS) - 1)
            self.dropped_ns = now_ns
        elif self.dropouts and now_ns - self.steady_since_ns >= FORGET_NS:
            self.dropouts -= 1
            self.steady_since_ns = now_ns

    @property
    def hold(self) -> bool:
        """True if every command is to carry `hold`."""
        return self.mode is not PlannerMode.LEADING
