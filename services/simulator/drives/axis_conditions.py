"""Conditions of the emulated drives: power, cables, heat, encoders. Set by faults, not by fronts.

A condition lasts until it is ended, and acts again at every step: errors that are cleared in the
heat return at once.
"""

from __future__ import annotations

import math
from typing import Final

from services.simulator.drives.axis_control import AxisControl
from services.simulator.drives.axis_encoders import AxisEncoders
from services.simulator.drives.axis_faults import FAULTS, AxisErrors
from services.simulator.drives.axis_settings import N_DRIVES, Settings
from shared.clamp import clamp
from shared.joints import N_JOINTS

BOOT_S: Final = 1.5
"""s from power to the first frame; the firmware waits so long before it starts its axes."""
ROOM_TEMPERATURE: Final = 25.0
"""C of the output stage."""
OVER_TEMP_MARGIN: Final = 5.0
"""C beyond `temp_limit_upper` at which the firmware disarms."""


class Conditions:
    """Conditions of all drives.

    Attributes:
        down: the drives (0 .. 5) that are without power or starting up.
        silent: the axes (0 .. 11) without communication: down, or the cable out.
        blind: the axes (0 .. 11) whose encoder is lost.
        temperature: of each axis's output stage (12,), C.
    """

    def __init__(self, settings: Settings, control: AxisControl, encoders: AxisEncoders) -> None:
        """Start without any condition."""
        self._settings, self._control, self._encoders = settings, control, encoders
        self.down: set[int] = set()
        self.silent: set[int] = set()
        self.blind: set[int] = set()
        self.temperature = [ROOM_TEMPERATURE] * N_JOINTS
        self._hot: set[int] = set()
        self._linked = [True] * N_DRIVES
        self._up_s = [-math.inf] * N_DRIVES  # when each will be up; inf: without power

    @property
    def all_well(self) -> bool:
        """True if no axis has to be looked at."""
        return not (self.down or self.blind or self._hot)

    def link(self, drive: int, *, up: bool) -> None:
        """Pull a drive's cable, or plug it in."""
        self._linked[drive] = up
        self._hush()

    def boot(self, drive: int, now_s: float) -> None:
        """Let a drive start up from now on."""
        self.down.add(drive)
        self._up_s[drive] = now_s + BOOT_S
        self._hush()

    def power_off(self, drive: int) -> None:
        """Keep a drive down until `boot`."""
        self.down.add(drive)
        self._up_s[drive] = math.inf
        self._hush()

    def is_off(self, drive: int) -> bool:
        """Return True if a drive is without power."""
        return self._up_s[drive] == math.inf

    def come_up(self, now_s: float) -> list[int]:
        """Return the drives whose start-up is over by now; they are down no more."""
        up = [drive for drive in self.down if self._up_s[drive] <= now_s]
        if up:
            self.down.difference_update(up)
            self._hush()
        return up

    def lose_encoder(self, axis: int, *, lost: bool) -> None:
        """Take an axis's encoder away, or bring it back."""
        if lost:
            self.blind.add(axis)
            self._encoders.blind(axis)  # it keeps its last reading
        elif axis in self.blind:
            self.blind.remove(axis)
            self._encoders.see_again(axis)

    def heat(self, axis: int, celsius: float) -> None:
        """Bring an axis's output stage to a temperature; near its limit the current is less."""
        self.temperature[axis] = celsius
        below = "motor.fet_thermistor.config."
        enabled = self._settings.axis(below + "enabled")[axis] > 0.0
        low = float(self._settings.axis(below + "temp_limit_lower")[axis])
        high = float(self._settings.axis(below + "temp_limit_upper")[axis])
        share = clamp((high - celsius) / (high - low), 0.0, 1.0) if enabled else 1.0
        self._control.derating[axis] = share
        over = enabled and celsius >= high + OVER_TEMP_MARGIN
        (self._hot.add if over else self._hot.discard)(axis)

    def failing(self) -> list[tuple[int, AxisErrors]]:
        """Return the axes that a condition disarms, and with what; blind ones stand still."""
        for axis in self.blind:
            self._encoders.blind(axis)
        failing = [(axis, FAULTS["ENCODER"]) for axis in sorted(self.blind)]
        return failing + [(axis, FAULTS["OVER_TEMP"]) for axis in sorted(self._hot)]

    def _hush(self) -> None:
        """Work out who is silent."""
        self.silent.clear()
        for axis in range(N_JOINTS):
            if axis >> 1 in self.down or not self._linked[axis >> 1]:
                self.silent.add(axis)
