"""Finds the messages that a service consumed, by the numbers in its trace."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from typing import Generic, TypeVar

from shared.bus.messages import Message

M = TypeVar("M", bound=Message)


class BySeq(Generic[M]):
    """Finds a sender's message by its number; a restarted sender counts from the start again."""

    def __init__(self, messages: Iterable[M]) -> None:
        self._rows: dict[int, list[M]] = {}
        for message in messages:
            self._rows.setdefault(message.seq, []).append(message)

    def at(self, seq: int, by_ns: int) -> M | None:
        """Return the newest message of this number that was made by a time; None if none was."""
        rows = self._rows.get(seq)
        if not rows:
            return None
        return rows[max(0, bisect_right(rows, by_ns, key=lambda row: row.t_ns) - 1)]
