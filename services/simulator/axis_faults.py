"""Error registers of the emulated drives, and faults by name.

What firmware 0.5.6 leaves in its registers. There `disarm_with_error` of the motor sets the
motor's register alone: `axis.error` stays 0 while the axis is disarmed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from shared.cansimple import (
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    OdriveError,
)
from shared.joints import MODULES

AXIS_NAMES: Final = tuple(f"{module}.axis{index}" for module in MODULES for index in (0, 1))
"""The 12 axes by name, in order."""


class Fault(NamedTuple):
    """The error registers of an axis, and that of its ODrive."""

    axis: int = 0
    motor: int = 0
    encoder: int = 0
    controller: int = 0
    odrive: int = 0
    """`odrv.error`; the same on both axes, for its errors disarm both."""

    def with_(self, other: Fault) -> Fault:
        """Return both together."""
        return Fault(*(a | b for a, b in zip(self, other, strict=True)))


FAULTS: Final[Mapping[str, Fault]] = {
    "DISARM": Fault(),
    "OVERSPEED": Fault(motor=MotorError.CONTROLLER_FAILED, controller=ControllerError.OVERSPEED),
    "SPINOUT": Fault(
        motor=MotorError.CONTROLLER_FAILED, controller=ControllerError.SPINOUT_DETECTED
    ),
    "DRV_FAULT": Fault(motor=MotorError.DRV_FAULT),
    "REGENERATION": Fault(motor=MotorError.I_BUS_OUT_OF_RANGE),
    "ENCODER": Fault(
        AxisError.ENCODER_FAILED,
        motor=MotorError.UNKNOWN_PHASE_ESTIMATE,
        encoder=EncoderError.NO_RESPONSE,
        controller=ControllerError.INVALID_ESTIMATE,
    ),
    "OVER_TEMP": Fault(motor=MotorError.FET_THERMISTOR_OVER_TEMP),
    "WATCHDOG": Fault(AxisError.WATCHDOG_TIMER_EXPIRED),
    "ESTOP": Fault(AxisError.ESTOP_REQUESTED),
}
"""Faults of one axis by name, for `AxisBank.inject`; its sibling keeps its torque.

DISARM is the silent one: IDLE and no error at all.
"""


def _system(error: OdriveError) -> Fault:
    return Fault(motor=MotorError.SYSTEM_LEVEL, odrive=error)


BUS_FAULTS: Final[Mapping[str, Fault]] = {
    "UNDER_VOLTAGE": _system(OdriveError.DC_BUS_UNDER_VOLTAGE),
    "OVER_VOLTAGE": _system(OdriveError.DC_BUS_OVER_VOLTAGE),
    "OVER_REGEN_CURRENT": _system(OdriveError.DC_BUS_OVER_REGEN_CURRENT),
    "OVER_CURRENT": _system(OdriveError.DC_BUS_OVER_CURRENT),
}
"""Faults of the DC bus by name: they disarm both axes of an ODrive."""
