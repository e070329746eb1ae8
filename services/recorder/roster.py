"""Tells twice a second, and whenever it changes, which tools are linked: for status and log."""

from __future__ import annotations

from typing import Final

from shared.bus import topics
from shared.bus.messages import ToolRoster
from shared.bus.session import Session
from shared.clock import NS_PER_MS, NS_PER_S

NEWS_NS: Final = 100 * NS_PER_MS
"""Between two messages, however many tools come and go."""


class Roster:
    """The recorder dials every service and is dialled by every tool: it knows them all."""

    def __init__(self, session: Session) -> None:
        """Begin to watch."""
        self._watch = session.linked_tools()
        self._publisher = session.publisher(topics.TOOLS, ToolRoster)
        self._told: tuple[str, ...] = ()
        self._told_ns = self._due_ns = 0
        self._seq = 0

    def put_if_due(self, now_ns: int) -> None:
        """Say who is linked, if that is news or due again; never blocks."""
        names = self._watch.names()
        is_news = names != self._told and now_ns >= self._told_ns + NEWS_NS
        if not is_news and now_ns < self._due_ns:
            return
        self._told_ns = now_ns
        self._told, self._due_ns = names, now_ns + round(NS_PER_S / topics.TOOLS.rate_hz)
        self._seq += 1
        self._publisher.put(ToolRoster(t_ns=now_ns, seq=self._seq, tools=names))
