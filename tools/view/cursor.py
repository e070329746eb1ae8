"""Where in a record one page is: playing, paused, at a rate. Pure: the clock is handed in."""

from __future__ import annotations

import math
from typing import Final

RATES: Final = (0.05, 20.0)


class TimelineCursor:
    """A place on a timeline that moves with a clock."""

    def __init__(self, begin_s: float, end_s: float) -> None:
        self._begin_s, self._end_s = begin_s, end_s
        self._place_s = max(begin_s, min(0.0, end_s))
        self._since_s: float | None = None
        self._rate = 1.0

    @property
    def playing(self) -> bool:
        """True while it moves."""
        return self._since_s is not None

    def at(self, now_s: float) -> float:
        """Return the place; at the end it stops."""
        if self._since_s is None:
            return self._place_s
        place = self._place_s + (now_s - self._since_s) * self._rate
        if place >= self._end_s:
            self._place_s, self._since_s = self._end_s, None
            return self._end_s
        return place

    def control(
        self, now_s: float, play: bool | None, seek_s: float | None, rate: float | None
    ) -> None:
        """Change what is not None; play at the end begins again, a rate stays within `RATES`."""
        place, moving = self.at(now_s), self.playing
        if seek_s is not None and math.isfinite(seek_s):
            place = min(max(seek_s, self._begin_s), self._end_s)
        if rate is not None and math.isfinite(rate):
            self._rate = min(max(rate, RATES[0]), RATES[1])
        if play is not None:
            moving = play
            if play and place >= self._end_s:
                place = self._begin_s
        self._place_s = place
        self._since_s = now_s if moving and self._end_s > self._begin_s else None
