"""CANSimple of ODrive firmware 0.6, where it differs from 0.5 (`shared.can.cansimple`).

These differ: heartbeat bytes 5 to 7; 0x000 (version); 0x003 (one pair of error words for the axis);
0x004 and 0x005 (any endpoint, read and written); 0x019 (position in turns as a float, in 0.5 as
counts); 0x018 (a byte that requests blinking); and the error numbers, such as the watchdog's
0x0100_0000 (0x800 in 0.5). Setpoints, limits, gains and estimates are as in 0.5.

From 0.6.11 on, a drive confirms each write of an endpoint with 0x005, just as it answers a read.

Source: docs.odriverobotics.com, manual/can-protocol, the published 0.6.10 .dbc, and the
enumerations of the `odrive` package 0.6.11.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from struct import Struct
from typing import Final, NamedTuple


class Command06(IntEnum):
    """Command ids that 0.5 lacks or uses for something else."""

    GET_VERSION = 0x000
    GET_ERROR = 0x003
    RX_SDO = 0x004
    TX_SDO = 0x005
    ADDRESS = 0x006
    GET_TEMPERATURE = 0x015
    SET_ABSOLUTE_POSITION = 0x019
    GET_TORQUES = 0x01C
    GET_POWERS = 0x01D


class DriveError06(IntFlag):
    """`active_errors` and `disarm_reason`."""

    NONE = 0
    INITIALIZING = 0x0000_0001
    SYSTEM_LEVEL = 0x0000_0002
    TIMING_ERROR = 0x0000_0004
    MISSING_ESTIMATE = 0x0000_0008
    BAD_CONFIG = 0x0000_0010
    DRV_FAULT = 0x0000_0020
    MISSING_INPUT = 0x0000_0040
    DC_BUS_OVER_VOLTAGE = 0x0000_0100
    DC_BUS_UNDER_VOLTAGE = 0x0000_0200
    DC_BUS_OVER_CURRENT = 0x0000_0400
    DC_BUS_OVER_REGEN_CURRENT = 0x0000_0800
    CURRENT_LIMIT_VIOLATION = 0x0000_1000
    MOTOR_OVER_TEMP = 0x0000_2000
    INVERTER_OVER_TEMP = 0x0000_4000
    VELOCITY_LIMIT_VIOLATION = 0x0000_8000
    POSITION_LIMIT_VIOLATION = 0x0001_0000
    REQUESTED_CURRENT_TOO_HIGH = 0x0002_0000
    WATCHDOG_TIMER_EXPIRED = 0x0100_0000
    ESTOP_REQUESTED = 0x0200_0000
    SPINOUT_DETECTED = 0x0400_0000
    BRAKE_RESISTOR_DISARMED = 0x0800_0000
    THERMISTOR_DISCONNECTED = 0x1000_0000
    CALIBRATION_ERROR = 0x4000_0000


class ProcedureResult(IntEnum):
    """Outcome of the last requested state."""

    SUCCESS = 0
    BUSY = 1
    CANCELLED = 2
    DISARMED = 3
    NO_RESPONSE = 4
    POLE_PAIR_CPR_MISMATCH = 5
    PHASE_RESISTANCE_OUT_OF_RANGE = 6
    PHASE_INDUCTANCE_OUT_OF_RANGE = 7
    UNBALANCED_PHASES = 8
    INVALID_MOTOR_TYPE = 9
    ILLEGAL_HALL_STATE = 10
    TIMEOUT = 11
    HOMING_WITHOUT_ENDSTOP = 12
    INVALID_STATE = 13
    NOT_CALIBRATED = 14
    NOT_CONVERGING = 15
    REQUESTED_CURRENT_TOO_HIGH = 16


class Heartbeat06(NamedTuple):
    """Payload of 0x001."""

    axis_error: int
    """`active_errors` and `disarm_reason` together, `DriveError06` bits."""
    axis_state: int
    procedure_result: int
    trajectory_done: bool


class Version(NamedTuple):
    """Payload of 0x000, which 0.5 never sends."""

    protocol: int
    hardware: tuple[int, int, int]
    firmware: tuple[int, int, int]
    unreleased: int


class SdoOpcode(IntEnum):
    """First byte of `RX_SDO`."""

    READ = 0
    WRITE = 1


_HEARTBEAT: Final = Struct("<IBBBx")
_VERSION: Final = Struct("<8B")
_TWO_U32: Final = Struct("<II")
_SDO: Final = Struct("<BHx")


def pack_heartbeat(heartbeat: Heartbeat06) -> bytes:
    """Pack 0x001."""
    return _HEARTBEAT.pack(*heartbeat)


def unpack_heartbeat(data: bytes) -> Heartbeat06:
    """Unpack 0x001."""
    error, state, result, done = _HEARTBEAT.unpack_from(data)
    return Heartbeat06(error, state, result, bool(done))


def pack_version(version: Version) -> bytes:
    """Pack 0x000."""
    return _VERSION.pack(version.protocol, *version.hardware, *version.firmware, version.unreleased)


def unpack_version(data: bytes) -> Version:
    """Unpack 0x000."""
    protocol, *rest, unreleased = _VERSION.unpack_from(data)
    return Version(protocol, (rest[0], rest[1], rest[2]), (rest[3], rest[4], rest[5]), unreleased)


def pack_error(active_errors: int, disarm_reason: int) -> bytes:
    """Pack 0x003."""
    return _TWO_U32.pack(active_errors, disarm_reason)


def pack_sdo(opcode: int, endpoint: int, value: bytes = b"") -> bytes:
    """Pack 0x004, or 0x005 with opcode 0; the value has the endpoint's type, at most 4 bytes."""
    return _SDO.pack(opcode, endpoint) + value


def unpack_sdo(data: bytes) -> tuple[int, int, bytes]:
    """Unpack 0x004 or 0x005 into opcode, endpoint and the value's bytes."""
    opcode, endpoint = _SDO.unpack_from(data)
    return opcode, endpoint, bytes(data[_SDO.size :])
