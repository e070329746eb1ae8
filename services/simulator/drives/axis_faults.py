"""Error registers of the emulated drives, and faults by name.

What firmware 0.5.6 leaves in its registers. What fails in the motor, the encoder or the
controller is in `axis.error` too (up to 0.5.4 that stayed 0); a controller that fails gives no
torque, so the motor misses its command in the same cycle.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from shared.can.cansimple import (
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    OdriveError,
)
from shared.joints import MODULES

AXIS_NAMES: Final = tuple(f"{module}.axis{index}" for module in MODULES for index in (0, 1))
"""The 12 axes by name, in order."""


class AxisErrors(NamedTuple):
    """The error registers of an axis, and that of its ODrive."""

    axis: int = 0
    motor: int = 0
    encoder: int = 0
    controller: int = 0
    odrive: int = 0
    """`odrv.error`; the same on both axes, for its errors disarm both."""

    def with_(self, other: AxisErrors) -> AxisErrors:
        """Return both together."""
        return AxisErrors(*(a | b for a, b in zip(self, other, strict=True)))


def _motor(error: MotorError) -> AxisErrors:
    return AxisErrors(AxisError.MOTOR_FAILED, motor=error)


def controller_fault(error: ControllerError) -> AxisErrors:
    """Return the torque of a failed controller: none."""
    no_command = MotorError.UNKNOWN_TORQUE | MotorError.UNKNOWN_VOLTAGE_COMMAND
    axis = AxisError.CONTROLLER_FAILED | AxisError.MOTOR_FAILED
    return AxisErrors(axis, motor=no_command, controller=error)


FAULTS: Final[Mapping[str, AxisErrors]] = {
    "DISARM": AxisErrors(),
    "OVERSPEED": controller_fault(ControllerError.OVERSPEED),
    "SPINOUT": controller_fault(ControllerError.SPINOUT_DETECTED),
    "DRV_FAULT": _motor(MotorError.DRV_FAULT),
    "REGENERATION": _motor(MotorError.I_BUS_OUT_OF_RANGE),
    "ENCODER": controller_fault(ControllerError.INVALID_ESTIMATE).with_(
        AxisErrors(AxisError.ENCODER_FAILED, encoder=EncoderError.ABS_SPI_COM_FAIL)
    ),
    "OVER_TEMP": _motor(MotorError.FET_THERMISTOR_OVER_TEMP),
    "WATCHDOG": AxisErrors(AxisError.WATCHDOG_TIMER_EXPIRED),
    "ESTOP": AxisErrors(AxisError.ESTOP_REQUESTED),
}
"""Faults of one axis by name, for `AxisBank.inject`; its sibling keeps its torque.

DISARM is the silent one: IDLE and no error at all.
"""


def _system(error: OdriveError) -> AxisErrors:
    return _motor(MotorError.SYSTEM_LEVEL)._replace(odrive=error)


BUS_FAULTS: Final[Mapping[str, AxisErrors]] = {
    "UNDER_VOLTAGE": _system(OdriveError.DC_BUS_UNDER_VOLTAGE),
    "OVER_VOLTAGE": _system(OdriveError.DC_BUS_OVER_VOLTAGE),
    "OVER_REGEN_CURRENT": _system(OdriveError.DC_BUS_OVER_REGEN_CURRENT),
    "OVER_CURRENT": _system(OdriveError.DC_BUS_OVER_CURRENT),
}
"""Faults of the DC bus by name: they disarm both axes of an ODrive."""
