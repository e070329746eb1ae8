"""Decides when all six modules track and when they hold (docs/architecture.md#modes).

All six modules track or none does. While one module's state is stale, or one module is not in
TRACK, every command carries `hold`, so that no leg works against the other. Modules report `ready`
once commands have been fresh for long enough. When all are ready, the planner engages: it lifts
`hold` for all in the same tick, and they have `GRACE_NS` to report TRACK. An overload at the
harness and gains that do not stand alone also set `hold`.

After a drop-out of any module, a trip, or gains that do not stand alone, the planner waits before
it re-engages; the wait grows with the number of recent drop-outs. Six links that drop out in turn
would otherwise make the robot flap between TRACK and HOLD. Pure: state, inputs -> outputs.
"""

from __future__ import annotations

from typing import Final

import msgspec

from shared.bus.messages import Mode, PlannerMode
from shared.clock import NS_PER_S
from shared.robot.hold_rules import Dropouts

GRACE_NS = 150_000_000
"""ns; after `hold` is lifted, modules may take this long to report TRACK."""
WAITS_NS: Final = tuple(round(s * NS_PER_S) for s in (0.0, 0.5, 1.5, 4.0, 10.0, 20.0, 30.0))
"""ns; shortest time from a drop-out to re-engaging, by the number of counted drop-outs. With these
and `FORGET_NS`, no network causes more than six drop-outs in a minute. Index 0: no drop-out
is counted."""
FORGET_NS: Final = 25 * NS_PER_S
"""ns; a time engaged without a drop-out that removes one from the count. With 20 s, seven drop-outs
would fit into a minute."""

_NOT_TRACKABLE: Final = (Mode.FAULT, Mode.DAMP)
"""Modes from which no module returns to TRACK, so that waiting is useless."""
_DROPPED: Final = (
    PlannerMode.WAITING, PlannerMode.ALIGNING, PlannerMode.TRIPPED, PlannerMode.UNCERTIFIED,
)  # fmt: skip
"""Modes after LEADING that count as a drop-out. OVERLOADED, MISLOADED and the stance have a time or
a band of their own before they end; gains at the edge of their margin have none."""

# Compared in each tick: docs/contributing.md, The control path.
_TRACK: Final = Mode.TRACK
_LEADING, _ALIGNING, _WAITING = PlannerMode.LEADING, PlannerMode.ALIGNING, PlannerMode.WAITING


class Engagement(msgspec.Struct):
    """State of the engagement."""

    mode: PlannerMode = PlannerMode.WAITING
    since_ns: int = 0
    """Time at which the mode was entered."""
    dropouts: Dropouts = msgspec.field(default_factory=Dropouts)
    """Recent drop-outs of modules; the count is an index of `WAITS_NS`."""

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
        self.dropouts.advance(
            now_ns,
            engaged=self.mode is _LEADING,
            dropped=next_mode in _DROPPED,
            count_max=len(WAITS_NS) - 1,
            forget_ns=FORGET_NS,
        )
        changed = next_mode is not self.mode
        if changed:
            self.mode, self.since_ns = next_mode, now_ns
        return changed

    def wait_ns(self, now_ns: int) -> int:
        """Return the rest of the wait after drop-outs, ns; 0 if the planner may engage."""
        return max(0, self.dropouts.last_ns + WAITS_NS[self.dropouts.count] - now_ns)

    def _next(
        self,
        now_ns: int,
        fresh: list[bool],
        ready: list[bool],
        modes: list[int],
        inhibit: PlannerMode | None,
    ) -> PlannerMode:
        if not all(fresh):
            return _WAITING
        if inhibit is not None:
            return inhibit
        if self.mode is _LEADING:
            grace_over = now_ns - self.since_ns > GRACE_NS
            dropped = any(
                mode in _NOT_TRACKABLE or (grace_over and mode != _TRACK) for mode in modes
            )
            return _ALIGNING if dropped else _LEADING
        if self.mode is _ALIGNING and not self.wait_ns(now_ns) and all(ready):
            return _LEADING
        return _ALIGNING

    @property
    def hold(self) -> bool:
        """True if every command is to carry `hold`."""
        return self.mode is not _LEADING
