"""Tells twice a second, and at each change, which tools are linked and what stops recording.

For `xrl status` and the log.
"""

from __future__ import annotations

from typing import Final

from shared.bus import topics
from shared.bus.messages import ToolRoster
from shared.bus.session import Session
from shared.clock import NS_PER_MS, NS_PER_S

NEWS_NS: Final = 100 * NS_PER_MS
"""Between two messages, however many tools come and go."""


class Roster:
    """Every tool dials the recorder, so the recorder knows all that are linked."""

    def __init__(self, session: Session) -> None:
        self._watch = session.linked_tools()
        self._publisher = session.publisher(topics.TOOLS, ToolRoster)
        self._told: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
        self._told_ns = self._due_ns = 0
        self._seq = 0

    def put_if_due(self, now_ns: int, trouble: tuple[str, ...]) -> None:
        """Say who is linked and what is wrong, if that is news or due again; never blocks."""
        told = self._watch.names(), trouble
        is_news = told != self._told and now_ns >= self._told_ns + NEWS_NS
        if not is_news and now_ns < self._due_ns:
            return
        self._told_ns = now_ns
        self._told, self._due_ns = told, now_ns + round(NS_PER_S / topics.TOOLS.rate_hz)
        self._seq += 1
        self._publisher.put(ToolRoster(t_ns=now_ns, seq=self._seq, tools=told[0], trouble=trouble))
