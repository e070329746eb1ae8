"""What a service consumed and knew, as its log has it."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from typing import Generic, TypeVar

import msgspec

from shared.bus.messages import Message
from shared.exceptions import RunError

M = TypeVar("M", bound=Message)
State = TypeVar("State")


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


def memory_of(text: str, kind: type[State]) -> State:
    """Return a recorded memory."""
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.DecodeError, RecursionError) as error:
        raise RunError(
            f"a service's memory in the log is no {kind.__name__}: {error}; execute it again with "
            "the checkout that wrote it (`xrl log info` tells its commit)"
        ) from None
