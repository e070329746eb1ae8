"""Two planners on one bus, by accident: the one that is followed leads on, the other waits. Pure.

A module takes another planner's commands once those of the present one are too old. A second
planner that sends takes one module after the other, each at the first message that comes late. So a
planner that sees modules follow another one sends nothing until that one has ended.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Final

import msgspec

from shared.bus.messages import JointState
from shared.clock import NS_PER_MS

AGAIN_NS: Final = 500 * NS_PER_MS
"""Time without a module that follows another planner, until this one may lead again: the other may
only have been held up."""


class RivalWatch(msgspec.Struct):
    """What a planner knows of another one."""

    yields: bool = False
    """True while this planner sends nothing."""
    session: int = 0
    """Session of the other planner; 0 if none was seen."""
    seen_ns: int = 0
    """When a module was last seen to follow it."""

    def advance(self, now_ns: int, own: int, states: Iterable[JointState], age_max_ns: int) -> bool:
        """Advance by one tick; return True if this planner stops or begins to send.

        Args:
            now_ns: the planner's clock.
            own: its session.
            states: of the modules that have sent one lately.
            age_max_ns: a module with an older command follows nobody.
        """
        follow = Counter(
            state.session for state in states if state.session and 0 <= state.age_ns <= age_max_ns
        )
        own_count = follow.pop(own, 0)
        # of planners with equally many modules, as after a start at the same time, one goes on
        rival, count = min(follow.items(), key=lambda row: (-row[1], row[0]), default=(0, 0))
        before = self.yields
        if count:
            self.session, self.seen_ns = rival, now_ns
            self.yields = (count, -rival) > (own_count, -own)
        elif self.yields:
            self.yields = now_ns - self.seen_ns < AGAIN_NS
        return self.yields is not before

    def describe(self) -> str:
        """Return what to say while it yields; else nothing."""
        if not self.yields:
            return ""
        return (
            f"another planner leads (session {self.session}), and this one sends nothing; end one "
            "of them: this one goes on when the other has ended"
        )
