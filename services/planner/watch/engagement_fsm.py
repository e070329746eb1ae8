"""Engagement: who leads, when all six modules track, and which of them stiffen. Pure.

**Engagement** (docs/architecture.md#modes). All six modules track or none does. While one module's
state is stale, or one module is not in TRACK, every command carries `hold`, so that no leg works
against the other. Modules report `ready` once commands have been fresh for long enough. When all
are ready, the planner engages: it lifts `hold` for all in the same tick, and they have `GRACE_NS`
to report TRACK. An overload at the harness and uncertified gains also set `hold`.

After a dropout of any module, a trip, or uncertified gains, the planner waits before it re-engages;
the wait grows with the number of recent dropouts. Without the wait, six links that drop out in turn
would make the robot flap between TRACK and HOLD.

**Two planners** on one bus, by accident (docs/architecture.md, Two planners). A planner that sees
modules follow a rival does not lead until the rival has ended. It announces itself by commands that
every module refuses; `xrl status` and the log then show both.

**Limp legs.** Modules stiffen when another one may be limp. Joint services on one host detect a
limp neighbour without a planner (`services.joint.neighbours`). The planner covers modules on other
hosts, and a module that restarts and stays DISARMED.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import DriveStatus, JointState, Mode, PlannerMode, Refusal
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import N_MODULES
from shared.robot.hold_rules import SUPPORT_FOR, Dropouts, Support

GRACE_NS = 150_000_000
"""Timeout for the modules to report TRACK after `hold` is lifted, ns."""
WAITS_NS: Final = tuple(round(s * NS_PER_S) for s in (0.0, 0.5, 1.5, 4.0, 10.0, 20.0, 30.0))
"""ns; minimum time from a dropout to re-engaging, by the number of counted dropouts (index 0:
none). With these and `FORGET_NS`, no network causes more than six dropouts in a minute."""
FORGET_NS: Final = 25 * NS_PER_S
"""ns; each such period, engaged and without a dropout, removes one dropout from the count. With
20 s, seven dropouts would fit into a minute."""

_NOT_TRACKABLE: Final = (Mode.FAULT, Mode.DAMP)
"""Modes from which no module returns to TRACK by itself, so waiting is useless."""
_DROPPED: Final = (
    PlannerMode.WAITING, PlannerMode.ALIGNING, PlannerMode.TRIPPED, PlannerMode.UNCERTIFIED,
)  # fmt: skip
"""Modes after LEADING that count as a dropout. OVERLOADED, MISLOADED and MISPLACED do not: unlike
UNCERTIFIED, each has its own delay or hysteresis."""

# Constants, because each tick compares them (docs/contributing.md, The control path).
_TRACK: Final = Mode.TRACK
_LEADING, _ALIGNING, _WAITING = PlannerMode.LEADING, PlannerMode.ALIGNING, PlannerMode.WAITING


class Engagement(msgspec.Struct):
    """State of the engagement."""

    mode: PlannerMode = PlannerMode.WAITING
    since_ns: int = 0
    """Time at which the mode was entered."""
    dropouts: Dropouts = msgspec.field(default_factory=Dropouts)
    """Recent dropouts of modules; the count is an index into `WAITS_NS`."""

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
            fresh: per module, True if a state has arrived within `planner.state_stale_ms`.
            ready: per module, `JointState.ready`.
            modes: per module, `JointState.mode`.
            inhibit: mode that prevents engaging, such as OVERLOADED; None if the planner may
                engage.
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
        """Return the remaining wait after dropouts, ns; 0 if it is over."""
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
        """True if every command carries `hold`."""
        return self.mode is not _LEADING


AGAIN_NS: Final = 500 * NS_PER_MS
"""Age of the rival's newest command above which a planner without followers may lead. A
rival with a younger command may merely be late."""


ANNOUNCE_NS: Final = 200 * NS_PER_MS
"""Period of announcements while yielding; shorter than the 0.5 s for which `xrl status` listens."""


class RivalWatch(msgspec.Struct):
    """State of the watch for a rival planner."""

    yields: bool = False
    """True while this planner yields to the rival and leads no module."""
    session: int = 0
    """Session of the rival; 0 if none was seen."""
    announced_ns: int = 0
    """Time of this planner's last announcement while yielding."""

    def advance(self, own: int, states: Sequence[JointState], age_max_ns: int) -> bool:
        """Advance by one tick.

        Args:
            own: this planner's session; its previous session was one lower.
            states: states of the modules that have sent one lately.
            age_max_ns: maximum age of a command; with an older one, a module holds.

        Returns:
            True if this planner must continue in a new session, because a module followed a rival
            and refuses the present session for good.
        """
        if all(state.session == own for state in states):  # as in nearly every tick
            self.yields = False
            return False
        mine = (own, own - 1)
        followed = any(state.session in mine and _is_in_use(state, age_max_ns) for state in states)
        within_ns = age_max_ns if followed else AGAIN_NS
        follow = Counter(
            state.session for state in states if state.session and _is_in_use(state, within_ns)
        )
        own_count = sum(follow.pop(session, 0) for session in mine)
        # if both have equally many modules, as after a simultaneous start, the lower session leads
        rival, count = min(follow.items(), key=lambda row: (-row[1], row[0]), default=(0, 0))
        self.session = rival or self.session
        self.yields = count > 0 and (count, -rival) > (own_count, -own)
        return not self.yields and any(
            state.refusal == Refusal.FOREIGN_SESSION
            and state.refused_session == own
            and state.session not in mine
            and not _is_in_use(state, age_max_ns)
            for state in states
        )

    def announces(self, now_ns: int) -> bool:
        """Return True if an announcement is due, and start its next period."""
        due = now_ns - self.announced_ns >= ANNOUNCE_NS
        if due:
            self.announced_ns = now_ns
        return due

    def describe(self) -> str:
        """Return a message about the rival while yielding; "" otherwise."""
        if not self.yields:
            return ""
        return (
            f"another planner leads (session {self.session}); end one of the two. This planner "
            "resumes when the other has ended"
        )


def _is_in_use(state: JointState, age_max_ns: int) -> bool:
    return 0 <= state.age_ns <= age_max_ns


DISARMED_NS: Final = 200 * NS_PER_MS
"""ns; a module that is DISARMED for longer is not about to take over its drive."""

# Constants, because each tick compares them for six modules.
_DISARMED, _FAULT, _HOLDING = Mode.DISARMED, Mode.FAULT, DriveStatus.HOLDING


class LimpLegWatch(msgspec.Struct):
    """Watch over modules that are DISARMED while their drives do not hold."""

    since_ns: tuple[int, ...] = (0,) * N_MODULES
    """Time from which each module has been in that state; 0 if it is not."""

    def advance(self, now_ns: int, states: Sequence[JointState]) -> Support:
        """Return the modules that must stiffen.

        FAULT counts in any state of the drive, because a drive that does not reply may hold or have
        no power.

        Args:
            now_ns: the planner's clock.
            states: newest state of each module, of any age.
        """
        self.since_ns = tuple(
            (since_ns or now_ns) if _is_down(state) else 0
            for since_ns, state in zip(self.since_ns, states, strict=True)
        )
        support = Support.NONE
        for state, since_ns, wanted in zip(states, self.since_ns, SUPPORT_FOR, strict=True):
            persists = since_ns > 0 and now_ns - since_ns >= DISARMED_NS
            if persists or state.mode == _FAULT:
                support = max(support, wanted)
        return support


def _is_down(state: JointState) -> bool:
    return state.mode == _DISARMED and state.drive != _HOLDING
