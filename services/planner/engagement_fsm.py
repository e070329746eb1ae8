"""Decides when all six modules track and when they hold (docs/architecture.md#age-rule).

All six modules track or none does. While one module's state is stale, or one module is not in
TRACK, every command carries `hold`, so that no leg works against the other. Modules report `ready`
once commands have been fresh for long enough. When all are ready, the planner engages: it lifts
`hold` for all in the same tick. An overload at the harness and gains that do not stand alone also
set `hold`.

After a drop-out of any module the planner waits before it re-engages; the wait grows with the
number of recent drop-outs. Six links that drop out in turn would otherwise make the robot flap
between TRACK and HOLD. Pure: state, inputs -> outputs.
"""

from __future__ import annotations

from typing import Final

import msgspec

from shared.bus.messages import Mode, PlannerMode
from shared.clock import NS_PER_S

GRACE_NS = 150_000_000
"""ns; after `hold` is lifted, modules may take this long to report TRACK."""
WAITS_NS: Final = tuple(round(s * NS_PER_S) for s in (0.0, 0.5, 1.5, 4.0, 10.0, 20.0, 30.0))
"""ns; shortest time from a drop-out to re-engaging, by the number of counted drop-outs. With these
and `FORGET_NS`, no network causes more than six drop-outs in a minute. The first wait is zero,
because one stall of the machine must not stop the operator."""
FORGET_NS: Final = 25 * NS_PER_S
"""ns; a time engaged without a drop-out that removes one from the count. With 20 s, seven drop-outs
would fit into a minute."""

_NOT_TRACKABLE: Final = (Mode.FAULT, Mode.DAMP)
"""Modes from which no module returns to TRACK, so that waiting is useless."""


class Engagement(msgspec.Struct):
    """State of the engagement."""

    mode: PlannerMode = PlannerMode.WAITING
    since_ns: int = 0
    """Time at which the mode was entered."""
    dropouts: int = 0
    """Drop-outs counted and not yet forgotten; an index of `WAITS_NS`."""
    dropped_ns: int = 0
    """Time of the last drop-out."""
    steady_since_ns: int = 0
    """Time since which the planner is engaged without a drop-out, or since one was forgotten."""

    def advance(
        self,
        now_ns: int,
        fresh: list[bool],
        ready: list[bool],
        modes: list[int],
        inhibit: PlannerMode | None = None,
    ) -> bool:
        """Advance by one tick; return True if the mode changed.

        Args:
            now_ns: the planner's clock.
            fresh: per module, a state has come within `planner.state_stale_ms`.
            ready: per module, `JointState.ready`.
            modes: per module, `JointState.mode`.
            inhibit: mode that says why the planner may not engage, such as OVERLOADED; None if it
                may.
        """
        next_mode = self._next(now_ns, fresh, ready, modes, inhibit)
        self._count_dropouts(now_ns, next_mode)
        changed = next_mode is not self.mode
        if changed:
            self.mode, self.since_ns = next_mode, now_ns
        return changed

    def wait_ns(self, now_ns: int) -> int:
        """Return the rest of the wait after drop-outs, ns; 0 if the planner may engage."""
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
            grace_over = now_ns - self.since_ns > GRACE_NS
            dropped = any(
                mode in _NOT_TRACKABLE or (grace_over and mode != Mode.TRACK) for mode in modes
            )
            return PlannerMode.ALIGNING if dropped else PlannerMode.LEADING
        if self.mode is PlannerMode.ALIGNING and not self.wait_ns(now_ns) and all(ready):
            return PlannerMode.LEADING
        return PlannerMode.ALIGNING

    def _count_dropouts(self, now_ns: int, next_mode: PlannerMode) -> None:
        """Count a drop-out, or forget one after `FORGET_NS` without any."""
        if self.mode is not PlannerMode.LEADING:
            self.steady_since_ns = now_ns
        elif next_mode in (PlannerMode.WAITING, PlannerMode.ALIGNING, PlannerMode.TRIPPED):
            self.dropouts = min(self.dropouts + 1, len(WAITS_NS) - 1)
            self.dropped_ns = now_ns
        elif self.dropouts and now_ns - self.steady_since_ns >= FORGET_NS:
            self.dropouts -= 1
            self.steady_since_ns = now_ns

    @property
    def hold(self) -> bool:
        """True if every command is to carry `hold`."""
        return self.mode is not PlannerMode.LEADING
