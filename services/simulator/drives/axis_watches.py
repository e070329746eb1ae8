"""What the firmware watches of an axis: its watchdog, and spinout after it was disarmed. Pure."""

from __future__ import annotations

import math
from typing import Final

from services.simulator.drives.axis_settings import Settings
from shared.joints import N_JOINTS

BANDWIDTH: Final = 20.0
"""rad/s of both filters."""
_BELOW: Final = "controller.config.spinout_"


class Watchdogs:
    """Watchdogs of all axes: each runs on from the time that it was fed with last.

    Firmware 0.5.6: feeding loads a counter with the timeout of that moment, and only an enabled
    watchdog counts it down. One that is enabled before it was fed has nothing left, and expires at
    once; setting its timeout meanwhile does not feed it.
    """

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


class Spinout:
    """SPINOUT_DETECTED of the axes that were disarmed under load.

    Firmware 0.5.6: a filter of the motor's electrical power less its copper losses goes on with its
    last value, while that of the mechanical power follows the torque that the controller would
    give. An axis that was lifting, and sinks now, brakes with power: a spinout, in IDLE. Armed
    emulated motors have both powers equal, as both are taken without the copper loss: none spins
    out.

    Attributes:
        watched: the filtered power of each, and the last one before, W.
    """

    def __init__(self, settings: Settings) -> None:
        """Take the settings: the thresholds."""
        self._mechanical = settings.axis(_BELOW + "mechanical_power_threshold")
        self._electrical = settings.axis(_BELOW + "electrical_power_threshold")
        self.watched: dict[int, tuple[float, float]] = {}

    def disarmed(self, axis: int, filtered: float, last: float) -> None:
        """Watch an axis that is disarmed at these powers, if they are high enough, W."""
        if max(filtered, last) > self._electrical[axis]:
            self.watched[axis] = filtered, last

    def armed(self, axis: int) -> None:
        """End the watch: both filters start again."""
        self.watched.pop(axis, None)

    def check(self, dt_s: float, mechanical: dict[int, float]) -> list[int]:
        """Return the axes that spin out, by each one's filtered mechanical power, W."""
        share = 1.0 - math.exp(-BANDWIDTH * dt_s)
        spun = []
        for axis, (filtered, last) in self.watched.items():
            now = filtered + share * (last - filtered)
            self.watched[axis] = now, last
            if mechanical[axis] < self._mechanical[axis] and now > self._electrical[axis]:
                spun.append(axis)
        return spun
