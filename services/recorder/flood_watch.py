"""Logs who floods the bus's ports on this host: no other service has the time to look."""

from __future__ import annotations

import logging
from typing import Final

from services.recorder.loop import Deadline
from shared.bus.arrivals import Arrivals
from shared.clock import NS_PER_S

_EVERY_NS: Final = 2 * NS_PER_S
_AGAIN_NS: Final = 10 * NS_PER_S
"""A flood that lasts is said so often."""


class FloodWatch:
    """Looks every two seconds."""

    def __init__(self, arrivals: Arrivals, logger: logging.Logger, now_ns: int) -> None:
        """Take where to look and where to say it."""
        self._arrivals, self._logger = arrivals, logger
        self._look = Deadline(_EVERY_NS, now_ns)
        self._say_at_ns = now_ns

    def look_if_due(self, now_ns: int) -> None:
        """Look, if it is time to, and say what there is to say."""
        if not self._look.passed(now_ns):
            return
        flood = self._arrivals.flood(now_ns)
        if flood and now_ns >= self._say_at_ns:
            self._say_at_ns = now_ns + _AGAIN_NS
            self._logger.warning("%s", flood)
