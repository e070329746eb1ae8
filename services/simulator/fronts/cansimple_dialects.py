"""The two dialects of CANSimple that the emulated drives use.

Firmware 0.5 and 0.6 share the frames of setpoints, limits and gains; `DIALECTS` contains the
differences. A trap of 0.5.6 is emulated: encoder frames contain 0, 0 from start-up until the first
closed loop. Each 0.6 firmware defines its endpoint ids in `flat_endpoints.json`; the emulation uses
`SDO_ENDPOINTS`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_faults import AxisErrors
from services.simulator.drives.axis_settings import AXIS_SETTINGS, DRIVE_SETTINGS, Value
from shared.can import cansimple, cansimple_06
from shared.can.cansimple import (
    AxisError,
    AxisState,
    Command,
    ControllerError,
    EncoderError,
    MotorError,
    OdriveError,
)
from shared.can.cansimple_06 import (
    Command06,
    DriveError06,
    Heartbeat06,
    ProcedureResult,
    SdoOpcode,
    Version,
)
from shared.exceptions import DriveError

DialectName = Literal["0.5", "0.6"]
Vector = NDArray[np.float64]
Answer = Callable[[AxisBank, int], bytes]
Setter = Callable[[AxisBank, int, bytes], None]

VERSION_06: Final = Version(protocol=2, hardware=(4, 4, 58), firmware=(0, 6, 11), unreleased=0)

_ERRORS_06: Final[tuple[tuple[str, int, DriveError06], ...]] = (
    ("axis", AxisError.WATCHDOG_TIMER_EXPIRED, DriveError06.WATCHDOG_TIMER_EXPIRED),
    ("axis", AxisError.ESTOP_REQUESTED, DriveError06.ESTOP_REQUESTED),
    ("motor", MotorError.DRV_FAULT, DriveError06.DRV_FAULT),
    ("motor", MotorError.FET_THERMISTOR_OVER_TEMP, DriveError06.INVERTER_OVER_TEMP),
    ("motor", MotorError.MOTOR_THERMISTOR_OVER_TEMP, DriveError06.MOTOR_OVER_TEMP),
    ("motor", MotorError.CURRENT_LIMIT_VIOLATION, DriveError06.CURRENT_LIMIT_VIOLATION),
    ("motor", MotorError.MODULATION_IS_NAN, DriveError06.MISSING_INPUT),
    ("motor", MotorError.UNKNOWN_PHASE_ESTIMATE, DriveError06.MISSING_ESTIMATE),
    ("motor", MotorError.I_BUS_OUT_OF_RANGE, DriveError06.DC_BUS_OVER_REGEN_CURRENT),
    ("encoder", EncoderError.ABS_SPI_COM_FAIL, DriveError06.MISSING_ESTIMATE),
    ("encoder", EncoderError.CPR_POLEPAIRS_MISMATCH, DriveError06.CALIBRATION_ERROR),
    ("encoder", EncoderError.NO_RESPONSE, DriveError06.CALIBRATION_ERROR),
    ("motor", MotorError.PHASE_RESISTANCE_OUT_OF_RANGE, DriveError06.CALIBRATION_ERROR),
    ("motor", MotorError.PHASE_INDUCTANCE_OUT_OF_RANGE, DriveError06.CALIBRATION_ERROR),
    ("controller", ControllerError.OVERSPEED, DriveError06.VELOCITY_LIMIT_VIOLATION),
    ("controller", ControllerError.INVALID_INPUT_MODE, DriveError06.BAD_CONFIG),
    ("controller", ControllerError.SPINOUT_DETECTED, DriveError06.SPINOUT_DETECTED),
    ("odrive", OdriveError.DC_BUS_UNDER_VOLTAGE, DriveError06.DC_BUS_UNDER_VOLTAGE),
    ("odrive", OdriveError.DC_BUS_OVER_VOLTAGE, DriveError06.DC_BUS_OVER_VOLTAGE),
    ("odrive", OdriveError.DC_BUS_OVER_REGEN_CURRENT, DriveError06.DC_BUS_OVER_REGEN_CURRENT),
    ("odrive", OdriveError.DC_BUS_OVER_CURRENT, DriveError06.DC_BUS_OVER_CURRENT),
)
"""Register and bit of 0.5, and the error of 0.6."""

_RESULTS_06: Final[tuple[tuple[str, int, ProcedureResult], ...]] = (
    ("encoder", EncoderError.CPR_POLEPAIRS_MISMATCH, ProcedureResult.POLE_PAIR_CPR_MISMATCH),
    ("encoder", EncoderError.NO_RESPONSE, ProcedureResult.NO_RESPONSE),
    ("motor", MotorError.UNKNOWN_PHASE_ESTIMATE, ProcedureResult.NOT_CALIBRATED),
    (
        "motor",
        MotorError.PHASE_RESISTANCE_OUT_OF_RANGE,
        ProcedureResult.PHASE_RESISTANCE_OUT_OF_RANGE,
    ),
    (
        "motor",
        MotorError.PHASE_INDUCTANCE_OUT_OF_RANGE,
        ProcedureResult.PHASE_INDUCTANCE_OUT_OF_RANGE,
    ),
)
"""Register and bit of 0.5, and the procedure result of 0.6."""

SDO_ENDPOINTS: Final[Mapping[int, str]] = dict(
    enumerate(("vbus_voltage", "ibus", *DRIVE_SETTINGS, *AXIS_SETTINGS), start=1)
)
"""Endpoint ids of the emulated 0.6 drive; an axis's settings are those of the addressed node."""

GPIOS: Final = 9
ANALOG_GPIOS: Final = range(1, 6)

_READINGS: Final = ("vbus_voltage", "ibus")
_SAVE: Final = 1  # action of 0.6's reboot frame: save the settings, then restart


class Dialect(NamedTuple):
    """Frames whose encoding depends on the firmware."""

    heartbeat: Answer
    estimates: Callable[[AxisBank], tuple[Vector, Vector]]
    """Position and velocity of all axes (12,), as in their frames."""
    answers: Mapping[int, Answer]
    """Answers to requests for data, by command."""
    asked: Mapping[int, Callable[[AxisBank, int, bytes], bytes | None]]
    """Answers to frames of any length, padded to eight bytes, by command; None for no answer."""
    sdo: Callable[[AxisBank, int, bytes], bytes | None] | None
    """Returns the payload of 0x005 for that of 0x004, or None for no answer; None without SDO."""
    setters: Mapping[int, Setter]
    """Setters by command, which replace the front's own."""


def errors_06(fault: AxisErrors) -> DriveError06:
    """Return the 0.6 errors for the 0.5 registers."""
    errors = DriveError06.NONE
    for register, bit, error in _ERRORS_06:
        if getattr(fault, register) & bit:
            errors |= error
    return errors


def _heartbeat_06(bank: AxisBank, axis: int) -> bytes:
    fault = bank.faults[axis]
    result = ProcedureResult.SUCCESS
    if bank.state[axis] not in (AxisState.IDLE, AxisState.UNDEFINED):
        result = ProcedureResult.BUSY
    elif fault.axis & AxisError.INVALID_STATE:
        ready = bank.calibration.ready(axis)
        result = ProcedureResult.INVALID_STATE if ready else ProcedureResult.NOT_CALIBRATED
    elif fault != AxisErrors():
        found = (each for register, bit, each in _RESULTS_06 if getattr(fault, register) & bit)
        result = next(found, ProcedureResult.DISARMED)
    return cansimple_06.pack_heartbeat(
        Heartbeat06(errors_06(fault), bank.state[axis], result, trajectory_done=True)
    )


def _estimates_05(bank: AxisBank) -> tuple[Vector, Vector]:
    """Return the controllers' estimates, which 0.5.6 reports: zero until the controllers run."""
    connected = bank.connected > 0.0
    return np.where(connected, bank.pos_estimate, 0.0), np.where(connected, bank.vel_estimate, 0.0)


def _estimates_06(bank: AxisBank) -> tuple[Vector, Vector]:
    return bank.pos_estimate, bank.vel_estimate


def _estimates_of_one(estimates: Callable[[AxisBank], tuple[Vector, Vector]]) -> Answer:
    def answer(bank: AxisBank, axis: int) -> bytes:
        pos, vel = estimates(bank)
        return cansimple.pack_two_floats(pos[axis], vel[axis])

    return answer


def _encoder_count(bank: AxisBank, axis: int) -> bytes:
    return cansimple.pack_two_ints(bank.encoder_count(axis), bank.encoder_angle(axis))


def _adc_voltage(_bank: AxisBank, _axis: int, data: bytes) -> bytes | None:
    """Return a pin's voltage: 0 V on GPIO 1 to 5, -3.3 V where a pin cannot measure."""
    pin = data[0]
    if pin >= GPIOS:
        return None
    return cansimple.pack_two_floats(0.0 if pin in ANALOG_GPIOS else -3.3, 0.0)


def _twice(value: float) -> bytes:
    """Return a frame of two floats with one value as both setpoint and measurement."""
    return cansimple.pack_two_floats(value, value)


def _sdo(bank: AxisBank, axis: int, data: bytes) -> bytes | None:
    """Read or write an endpoint; return its value as the answer, or None if it does not exist.

    Firmware 0.6.11 and later confirm a write. A value that is not a number is neither written nor
    confirmed.
    """
    opcode, endpoint, value = cansimple_06.unpack_sdo(data)
    name = SDO_ENDPOINTS.get(endpoint)
    if name is None:
        return None
    drive = axis >> 1
    if opcode == SdoOpcode.WRITE and name not in _READINGS:
        full = _full(name, axis)
        layout = _sdo_layout(bank.settings.get(drive, full))
        number: Value = struct.unpack_from(layout, value.ljust(4, b"\0"))[0]
        try:
            bank.settings.set(drive, full, number)
        except DriveError:
            return None
    elif opcode != SdoOpcode.READ:
        return None
    if name in _READINGS:
        reading: Value = bank.bus.state(drive)[_READINGS.index(name)]
    else:
        reading = bank.settings.get(drive, _full(name, axis))
    layout = _sdo_layout(reading)
    return cansimple_06.pack_sdo(0, endpoint, struct.pack(layout, reading).ljust(4, b"\0"))


def _set_absolute_position(bank: AxisBank, axis: int, data: bytes) -> None:
    turns = cansimple.unpack_float(data)
    if math.isfinite(turns):
        bank.set_count(axis, turns * bank.settings.axis("encoder.config.cpr")[axis])


def _reboot(bank: AxisBank, axis: int, data: bytes) -> None:
    """Restart the drive; with action 1, save its settings first (2, erase, is not emulated)."""
    if data[0] == _SAVE:
        bank.settings.save(axis >> 1)
    bank.reboot(axis)


def _full(name: str, axis: int) -> str:
    return name if name in DRIVE_SETTINGS else f"axis{axis & 1}.{name}"


def _sdo_layout(value: Value) -> str:
    if isinstance(value, bool):
        return "<?"
    return "<I" if isinstance(value, int) else "<f"


_BOTH: Final[Mapping[int, Answer]] = {
    Command.GET_IQ: lambda bank, axis: cansimple.pack_two_floats(*bank.currents(axis)),
    Command.GET_VBUS: lambda bank, axis: cansimple.pack_two_floats(*bank.bus.state(axis >> 1)),
}
_ANSWERS_05: Final[Mapping[int, Answer]] = {
    Command.GET_ENCODER_ESTIMATES: _estimates_of_one(_estimates_05),
    Command.GET_ENCODER_COUNT: _encoder_count,
    Command.GET_MOTOR_ERROR: lambda b, axis: cansimple.pack_motor_error(b.faults[axis].motor),
    Command.GET_SENSORLESS_ERROR: lambda _bank, _axis: bytes(8),
    Command.GET_SENSORLESS_ESTIMATES: lambda _bank, _axis: bytes(8),
    Command.GET_ENCODER_ERROR: lambda b, axis: struct.pack("<II", b.faults[axis].encoder, 0),
}
_ASKED_05: Final[Mapping[int, Callable[[AxisBank, int, bytes], bytes | None]]] = {
    Command.GET_CONTROLLER_ERROR: lambda b, a, _: struct.pack("<II", b.faults[a].controller, 0),
    Command.GET_ADC_VOLTAGE: _adc_voltage,
}
_ANSWERS_06: Final[Mapping[int, Answer]] = {
    Command.GET_ENCODER_ESTIMATES: _estimates_of_one(_estimates_06),
    Command06.GET_VERSION: lambda _bank, _axis: cansimple_06.pack_version(VERSION_06),
    Command06.GET_ERROR: lambda b, axis: cansimple_06.pack_error(*[errors_06(b.faults[axis])] * 2),
    Command06.GET_TEMPERATURE: lambda bank, axis: cansimple.pack_two_floats(
        bank.heat.fet[axis], bank.heat.motor[axis]
    ),
    Command06.GET_TORQUES: lambda bank, axis: _twice(bank.torque[axis]),
    Command06.GET_POWERS: lambda bank, axis: cansimple.pack_two_floats(*bank.bus.powers(axis)),
}

DIALECTS: Final[Mapping[DialectName, Dialect]] = {
    "0.5": Dialect(
        heartbeat=lambda bank, axis: cansimple.pack_heartbeat(bank.heartbeat(axis)),
        estimates=_estimates_05,
        answers={**_BOTH, **_ANSWERS_05},
        asked=_ASKED_05,
        sdo=None,
        setters={},
    ),
    "0.6": Dialect(
        heartbeat=_heartbeat_06,
        estimates=_estimates_06,
        answers={**_BOTH, **_ANSWERS_06},
        asked={},
        sdo=_sdo,
        setters={
            Command.REBOOT: _reboot,
            Command06.SET_ABSOLUTE_POSITION: _set_absolute_position,
        },
    ),
}
