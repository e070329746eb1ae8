"""SPINOUT_DETECTED of an axis that was disarmed under load.

Firmware 0.5.6: a filter of the motor's electrical power less its copper losses goes on with the
last value of before, while that of the mechanical power follows the torque that the controller
would give. So an axis that was lifting, and sinks now, brakes with power: a spinout, in IDLE. Armed
emulated motors have both powers equal, as both are taken without the copper loss: none spins out.
Pure.
"""

from __future__ import annotations

import math
from typing import Final

from services.simulator.drives.axis_settings import Settings

BANDWIDTH: Final = 20.0
"""rad/s of both filters."""
_BELOW: Final = "controller.config.spinout_"


class Spinout:
    """The axes that were disarmed with so much power that they may spin out.

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
