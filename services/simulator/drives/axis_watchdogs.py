"""Watchdogs of the emulated axes: each runs on from what it was fed with last.

Firmware 0.5.6: feeding loads a counter with the timeout of that moment, and only an enabled
watchdog counts it down. One that is enabled before it was fed has nothing left, and expires at
once; that its timeout is set meanwhile does not feed it. Pure: no clock.
"""

from __future__ import annotations

import math

from services.simulator.drives.axis_settings import Settings
from shared.joints import N_JOINTS


class Watchdogs:
    """The watchdogs of all axes."""

    def __init__(self, settings: Settings) -> None:
        """Take the settings; power-up feeds them."""
        self._settings = settings
        self._seen = -1
        self._timeouts_s = [0.0] * N_JOINTS
        self._left_s = [0.0] * N_JOINTS  # of those that are off
        self._off_s = [math.inf] * N_JOINTS  # 0 or infinite
        self._expire_s = [math.inf] * N_JOINTS

    def feed(self, axis: int, now_s: float) -> None:
        """Load an axis's watchdog with its timeout."""
        if self._seen != self._settings.version:
            self._take_settings(now_s)
        self._left_s[axis] = timeout_s = self._timeouts_s[axis]
        self._expire_s[axis] = now_s + timeout_s + self._off_s[axis]

    def expired(self, now_s: float) -> list[int]:
        """Return the axes whose watchdogs have run out."""
        if self._seen != self._settings.version:
            self._take_settings(now_s)
        if min(self._expire_s) >= now_s:
            return []
        return [axis for axis, expire_s in enumerate(self._expire_s) if expire_s < now_s]

    def _take_settings(self, now_s: float) -> None:
        self._seen = self._settings.version
        self._timeouts_s = self._settings.axis("config.watchdog_timeout").tolist()
        enabled = self._settings.axis("config.enable_watchdog").tolist()
        for axis, (on, off_s) in enumerate(zip(enabled, self._off_s, strict=True)):
            if on and off_s:
                self._off_s[axis] = 0.0
                self._expire_s[axis] = now_s + self._left_s[axis]
            elif not on and not off_s:
                self._off_s[axis] = math.inf
                self._left_s[axis] = max(0.0, self._expire_s[axis] - now_s)
                self._expire_s[axis] = math.inf
