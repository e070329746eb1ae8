"""Two planners on one bus, by accident: the one that is followed leads on, the other waits. Pure.

A module takes another planner's commands once those of the present one are too old. A second
planner that sends takes one module after the other, each at the first message that comes late. So a
planner that sees modules follow another one leads none until that one has ended. It makes itself
known by commands that every module refuses: `xrl status` and the log then tell of both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec

from shared.bus.messages import JointState, Refusal
from shared.clock import NS_PER_MS

AGAIN_NS: Final = 500 * NS_PER_MS
"""Age of another planner's newest command from which one that nobody follows may lead: younger, the
other may only have been held up."""


ANNOUNCE_NS: Final = 200 * NS_PER_MS
"""Within the window of `xrl status`."""


class RivalWatch(msgspec.Struct):
    """What a planner knows of another one."""

    yields: bool = False
    """True while this planner leads no module."""
    session: int = 0
    """Session of the other planner; 0 if none was seen."""
    announced_ns: int = 0
    """When this planner, as it yields, last made itself known."""

    def advance(self, own: int, states: Sequence[JointState], age_max_ns: int) -> bool:
        """Advance by one tick.

        Args:
            own: this planner's session; the one below it was its own before.
            states: of the modules that have sent one lately.
            age_max_ns: a module with an older command holds.

        Returns:
            True if this planner has to go on in a new session: a module has retired its own for
            another's, and refuses it for good.
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
        # of planners with equally many modules, as after a start at the same time, one goes on
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
        """Return True if a planner that yields is to make itself known now."""
        due = now_ns - self.announced_ns >= ANNOUNCE_NS
        if due:
            self.announced_ns = now_ns
        return due

    def describe(self) -> str:
        """Return what to say while it yields; else nothing."""
        if not self.yields:
            return ""
        return (
            f"another planner leads (session {self.session}), and this one waits; end one of them: "
            "this one goes on when the other has ended"
        )


def _is_in_use(state: JointState, age_max_ns: int) -> bool:
    return 0 <= state.age_ns <= age_max_ns
