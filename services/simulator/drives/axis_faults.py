"""Faults of the emulated drives: error registers by name, and lasting conditions.

The registers are those of firmware 0.5.6. A failure of motor, encoder or controller also sets
`axis.error` (up to 0.5.4 it stayed 0). A failed controller gives no torque, so the motor reports a
missing command in the same cycle.

A condition (power, cable, heat, encoder) acts at every step until it ends. For example, an error
that is cleared while the drive is hot returns at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

from services.simulator.drives.axis_encoders import AxisEncoders, Words
from services.simulator.drives.axis_heat import AxisHeat
from services.simulator.drives.axis_settings import N_DRIVES
from shared.can.cansimple import (
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    OdriveError,
)
from shared.joints import MODULES, N_JOINTS

AXIS_NAMES: Final = tuple(f"{module}.axis{index}" for module in MODULES for index in (0, 1))
"""The 12 axes by name, in order."""


class AxisErrors(NamedTuple):
    """Error registers of an axis and its ODrive."""

    axis: int = 0
    motor: int = 0
    encoder: int = 0
    controller: int = 0
    odrive: int = 0
    """`odrv.error`; the same on both axes, because its errors disarm both."""

    def with_(self, other: AxisErrors) -> AxisErrors:
        """Return these errors together with the others."""
        return AxisErrors(*(a | b for a, b in zip(self, other, strict=True)))


_MOTOR: Final = AxisError.MOTOR_FAILED


def motor_fault(error: MotorError) -> AxisErrors:
    """Return the errors of a failed motor."""
    return AxisErrors(_MOTOR, motor=error)


def encoder_fault(error: EncoderError) -> AxisErrors:
    """Return the errors of a failed encoder."""
    return AxisErrors(AxisError.ENCODER_FAILED, encoder=error)


def controller_fault(error: ControllerError) -> AxisErrors:
    """Return the errors of a failed controller, which gives no torque."""
    no_command = MotorError.UNKNOWN_TORQUE | MotorError.UNKNOWN_VOLTAGE_COMMAND
    axis = AxisError.CONTROLLER_FAILED | _MOTOR
    return AxisErrors(axis, motor=no_command, controller=error)


def in_idle(fault: AxisErrors, *, connected: bool) -> AxisErrors:
    """Return a fault's errors on an axis in IDLE, whose motor expects no command.

    Before its first closed loop a controller is not connected, so it detects no invalid estimate.
    """
    if not fault.controller:
        return fault
    if connected:
        return fault._replace(axis=fault.axis & ~_MOTOR, motor=MotorError.UNKNOWN_TORQUE)
    controller = fault.controller & ~ControllerError.INVALID_ESTIMATE
    lost = _MOTOR if controller else _MOTOR | AxisError.CONTROLLER_FAILED
    return fault._replace(axis=fault.axis & ~lost, motor=0, controller=controller)


FAULTS: Final[Mapping[str, AxisErrors]] = {
    "DISARM": AxisErrors(),
    "OVERSPEED": controller_fault(ControllerError.OVERSPEED),
    "SPINOUT": controller_fault(ControllerError.SPINOUT_DETECTED),
    "DRV_FAULT": motor_fault(MotorError.DRV_FAULT),
    "CURRENT_LIMIT": motor_fault(MotorError.CURRENT_LIMIT_VIOLATION),
    "MODULATION_IS_NAN": motor_fault(MotorError.MODULATION_IS_NAN),
    "NO_PHASE": motor_fault(MotorError.UNKNOWN_PHASE_ESTIMATE),
    "REGENERATION": motor_fault(MotorError.I_BUS_OUT_OF_RANGE),
    "ENCODER": controller_fault(ControllerError.INVALID_ESTIMATE).with_(
        encoder_fault(EncoderError.ABS_SPI_COM_FAIL)
    ),
    "OVER_TEMP": motor_fault(MotorError.FET_THERMISTOR_OVER_TEMP),
    "MOTOR_OVER_TEMP": motor_fault(MotorError.MOTOR_THERMISTOR_OVER_TEMP),
    "WATCHDOG": AxisErrors(AxisError.WATCHDOG_TIMER_EXPIRED),
    "ESTOP": AxisErrors(AxisError.ESTOP_REQUESTED),
}
"""Faults of an axis by name, for `AxisBank.inject`; except for `SHARED_FAULTS`, the sibling keeps
its torque. DISARM leads to IDLE without an error.
"""

SHARED_FAULTS: Final = frozenset({"DRV_FAULT"})
"""Faults that both axes of an ODrive have at once, because its gate drivers share a fault line."""


def _system(error: OdriveError) -> AxisErrors:
    return motor_fault(MotorError.SYSTEM_LEVEL)._replace(odrive=error)


BUS_FAULTS: Final[Mapping[str, AxisErrors]] = {
    "UNDER_VOLTAGE": _system(OdriveError.DC_BUS_UNDER_VOLTAGE),
    "OVER_VOLTAGE": _system(OdriveError.DC_BUS_OVER_VOLTAGE),
    "OVER_REGEN_CURRENT": _system(OdriveError.DC_BUS_OVER_REGEN_CURRENT),
    "OVER_CURRENT": _system(OdriveError.DC_BUS_OVER_CURRENT),
}
"""Faults of the DC bus by name: they disarm both axes of an ODrive."""

TALKS_S: Final = 0.02
"""Time from power-up to the first frame, s."""
BOOT_S: Final = 1.54
"""Time from power-up to the start of the axes, s; the firmware first measures current offsets."""


class Conditions:
    """Conditions of all drives.

    Attributes:
        down: the drives (0 .. 5) that are without power, or do not communicate yet.
        starting: the drives whose axes do not run yet and execute no request.
        silent: the axes (0 .. 11) without communication: down, or unplugged.
        deaf: the axes (0 .. 11) that receive and acknowledge nothing, but still send.
        choked: the axes (0 .. 11) whose bus accepts no frames, because its send queue is full.
        heat: motors, output stages and their thermistors.
    """

    def __init__(self, heat: AxisHeat, encoders: AxisEncoders) -> None:
        """Start without any condition."""
        self.heat, self._encoders = heat, encoders
        self.down: set[int] = set()
        self.starting: set[int] = set()
        self.silent: set[int] = set()
        self.deaf: set[int] = set()
        self.choked: set[int] = set()
        self._linked = [True] * N_DRIVES
        self._on_s = [-math.inf] * N_DRIVES  # power-up time of each; inf without power

    @property
    def all_well(self) -> bool:
        """True if no axis needs a check."""
        return not (self.starting or self._encoders.odd or self.heat.hot)

    def link(self, drive: int, *, up: bool) -> None:
        """Unplug a drive's cable, or plug it in."""
        self._linked[drive] = up
        self._update_silent()

    def deafen(self, drive: int, *, deaf: bool) -> None:
        """Break a drive's receiver, or repair it."""
        axes = (2 * drive, 2 * drive + 1)
        (self.deaf.update if deaf else self.deaf.difference_update)(axes)

    def choke(self, drive: int, *, full: bool) -> None:
        """Fill the send queue of a drive's bus with frames of other nodes, or empty it."""
        axes = (2 * drive, 2 * drive + 1)
        (self.choked.update if full else self.choked.difference_update)(axes)

    def boot(self, drive: int, now_s: float) -> None:
        """Start booting a drive."""
        self.down.add(drive)
        self.starting.add(drive)
        self._on_s[drive] = now_s
        self._update_silent()

    def power_off(self, drive: int) -> None:
        """Switch a drive off until `boot`."""
        self.boot(drive, math.inf)

    def is_off(self, drive: int) -> bool:
        """Return True if a drive is without power."""
        return self._on_s[drive] == math.inf

    def finish_boots(self, now_s: float) -> list[int]:
        """Start the communication and axes of drives when due; return drives whose axes start."""
        up = [drive for drive in self.down if self._on_s[drive] + TALKS_S <= now_s]
        if up:
            self.down.difference_update(up)
            self._update_silent()
        begin = [drive for drive in self.starting if self._on_s[drive] + BOOT_S <= now_s]
        self.starting.difference_update(begin)
        return begin

    def read_encoder(self, axis: int, words: Words) -> None:
        """Set the words that an axis reads from its encoder."""
        self._encoders.read_words(axis, words)

    def disarming(self) -> list[tuple[int, AxisErrors]]:
        """Return the axes that a condition disarms, with their errors."""
        odd = self._encoders.odd
        failing = [(axis, FAULTS["ENCODER"]) for axis in sorted(odd) if odd[axis].fails]
        names = {False: "OVER_TEMP", True: "MOTOR_OVER_TEMP"}
        hot = self.heat.hot.items()
        return failing + [(axis, FAULTS[names[motor]]) for axis, motor in sorted(hot)]

    def _update_silent(self) -> None:
        self.silent.clear()
        for axis in range(N_JOINTS):
            if axis >> 1 in self.down or not self._linked[axis >> 1]:
                self.silent.add(axis)
