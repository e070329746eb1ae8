"""The firmware's checks of an axis: its watchdog, and spinout after disarming. Pure."""

from __future__ import annotations

import math
from typing import Final

from services.simulator.drives.axis_settings import Settings
from shared.joints import N_JOINTS

BANDWIDTH: Final = 20.0
"""Bandwidth of both power filters, rad/s."""
_BELOW: Final = "controller.config.spinout_"


class Watchdogs:
    """Watchdogs of all axes; each counts down from the timeout at its last feed.

    In firmware 0.5.6, feeding loads a counter with the present timeout, and only an enabled
    watchdog counts it down. A watchdog that is enabled before it is fed has a counter of 0 and
    expires at once. Setting its timeout does not feed it.
    """

    def __init__(self, settings: Settings) -> None:
        """Bind the settings; power-up feeds the watchdogs."""
        self._settings = settings
        self._seen = -1
        self._timeouts_s = [0.0] * N_JOINTS
        self._left_s = [0.0] * N_JOINTS  # of disabled watchdogs
        self._off_s = [math.inf] * N_JOINTS  # infinite if disabled, else 0
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


class Spinout:
    """Check for SPINOUT_DETECTED on axes that were disarmed under load.

    In firmware 0.5.6, after disarming, the filter of electrical power minus copper losses continues
    with its last input. The filter of mechanical power follows the torque that the controller would
    give. An axis that was lifting and now sinks seems to draw power while it brakes, so the
    firmware reports a spinout in IDLE. For armed emulated motors both powers exclude the copper
    loss and are equal, so no armed axis spins out.

    Attributes:
        watched: filtered electrical power of each watched axis, and its last input, W.
    """

    def __init__(self, settings: Settings) -> None:
        """Set the thresholds from the settings."""
        self._mechanical = settings.axis(_BELOW + "mechanical_power_threshold")
        self._electrical = settings.axis(_BELOW + "electrical_power_threshold")
        self.watched: dict[int, tuple[float, float]] = {}

    def disarmed(self, axis: int, filtered: float, last: float) -> None:
        """Watch a disarmed axis if its filtered or last electrical power, W, is high enough."""
        if max(filtered, last) > self._electrical[axis]:
            self.watched[axis] = filtered, last

    def armed(self, axis: int) -> None:
        """End the watch, because both filters restart."""
        self.watched.pop(axis, None)

    def check(self, dt_s: float, mechanical: dict[int, float]) -> list[int]:
        """Return the axes that spin out, from their filtered mechanical powers, W."""
        share = 1.0 - math.exp(-BANDWIDTH * dt_s)
        spun = []
        for axis, (filtered, last) in self.watched.items():
            now = filtered + share * (last - filtered)
            self.watched[axis] = now, last
            if mechanical[axis] < self._mechanical[axis] and now > self._electrical[axis]:
                spun.append(axis)
        return spun
