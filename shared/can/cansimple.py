"""CANSimple, the CAN protocol of ODrive firmware 0.5.6 (docs/drives.md).

Pure packing and unpacking of frame payloads; no bus, no state. A frame's arbitration id is `node_id
<< 5 | command`; payloads are little-endian. Positions are in motor turns, velocities in turn/s,
torques in N m, currents in A.

Source: odriverobotics/ODrive, docs/can-protocol and
Firmware/communication/can/can_simple.cpp. Firmware 0.6 differs in 0x003 to 0x005, 0x019
and heartbeat bytes 5 to 7: see `shared.can.cansimple_06`.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum, IntFlag
from struct import Struct
from typing import Final, NamedTuple

NODE_BITS: Final = 6
COMMAND_BITS: Final = 5
COMMAND_MASK: Final = (1 << COMMAND_BITS) - 1
NODE_MASK: Final = (1 << NODE_BITS) - 1


class Command(IntEnum):
    """Command ids: the low five bits of the arbitration id."""

    HEARTBEAT = 0x001
    ESTOP = 0x002
    GET_MOTOR_ERROR = 0x003
    GET_ENCODER_ERROR = 0x004
    GET_SENSORLESS_ERROR = 0x005
    SET_AXIS_NODE_ID = 0x006
    SET_AXIS_STATE = 0x007
    GET_ENCODER_ESTIMATES = 0x009
    GET_ENCODER_COUNT = 0x00A
    SET_CONTROLLER_MODE = 0x00B
    SET_INPUT_POS = 0x00C
    SET_INPUT_VEL = 0x00D
    SET_INPUT_TORQUE = 0x00E
    SET_LIMITS = 0x00F
    START_ANTICOGGING = 0x010
    SET_TRAJ_VEL_LIMIT = 0x011
    SET_TRAJ_ACCEL_LIMITS = 0x012
    SET_TRAJ_INERTIA = 0x013
    GET_IQ = 0x014
    GET_SENSORLESS_ESTIMATES = 0x015
    REBOOT = 0x016
    GET_VBUS = 0x017
    CLEAR_ERRORS = 0x018
    SET_LINEAR_COUNT = 0x019
    SET_POS_GAIN = 0x01A
    SET_VEL_GAINS = 0x01B
    GET_ADC_VOLTAGE = 0x01C
    GET_CONTROLLER_ERROR = 0x01D


class AxisState(IntEnum):
    """`axis.current_state` and `axis.requested_state`; 14 and above: firmware 0.6 only."""

    UNDEFINED = 0
    IDLE = 1
    STARTUP_SEQUENCE = 2
    FULL_CALIBRATION_SEQUENCE = 3
    MOTOR_CALIBRATION = 4
    SENSORLESS_CONTROL = 5
    ENCODER_INDEX_SEARCH = 6
    ENCODER_OFFSET_CALIBRATION = 7
    CLOSED_LOOP_CONTROL = 8
    LOCKIN_SPIN = 9
    ENCODER_DIR_FIND = 10
    HOMING = 11
    ENCODER_HALL_POLARITY_CALIBRATION = 12
    ENCODER_HALL_PHASE_CALIBRATION = 13
    ANTICOGGING_CALIBRATION = 14
    HARMONIC_CALIBRATION = 15
    HARMONIC_CALIBRATION_COMMUTATION = 16


class ControlMode(IntEnum):
    """`controller.config.control_mode`."""

    VOLTAGE = 0
    TORQUE = 1
    VELOCITY = 2
    POSITION = 3


class InputMode(IntEnum):
    """`controller.config.input_mode`."""

    INACTIVE = 0
    PASSTHROUGH = 1
    VEL_RAMP = 2
    POS_FILTER = 3
    MIX_CHANNELS = 4
    TRAP_TRAJ = 5
    TORQUE_RAMP = 6
    MIRROR = 7
    TUNING = 8


class AxisError(IntFlag):
    """`axis.error`.

    From 0.5.5 on it is set if motor, encoder or controller failed; up to 0.5.4 it then stays 0. In
    every version it is 0 for an axis that is idle without its own error.
    """

    NONE = 0
    INVALID_STATE = 0x0000_0001
    MOTOR_FAILED = 0x0000_0040
    SENSORLESS_ESTIMATOR_FAILED = 0x0000_0080
    ENCODER_FAILED = 0x0000_0100
    CONTROLLER_FAILED = 0x0000_0200
    WATCHDOG_TIMER_EXPIRED = 0x0000_0800
    MIN_ENDSTOP_PRESSED = 0x0000_1000
    MAX_ENDSTOP_PRESSED = 0x0000_2000
    ESTOP_REQUESTED = 0x0000_4000
    HOMING_WITHOUT_ENDSTOP = 0x0002_0000
    OVER_TEMP = 0x0004_0000
    UNKNOWN_POSITION = 0x0008_0000


class MotorError(IntFlag):
    """The part of `motor.error` that this project names."""

    NONE = 0
    PHASE_RESISTANCE_OUT_OF_RANGE = 0x0000_0001
    PHASE_INDUCTANCE_OUT_OF_RANGE = 0x0000_0002
    DRV_FAULT = 0x0000_0008
    MODULATION_MAGNITUDE = 0x0000_0080
    CURRENT_LIMIT_VIOLATION = 0x0000_1000
    MODULATION_IS_NAN = 0x0001_0000
    MOTOR_THERMISTOR_OVER_TEMP = 0x0002_0000
    FET_THERMISTOR_OVER_TEMP = 0x0004_0000
    CONTROLLER_FAILED = 0x0020_0000
    I_BUS_OUT_OF_RANGE = 0x0040_0000
    SYSTEM_LEVEL = 0x0100_0000
    UNKNOWN_PHASE_ESTIMATE = 0x0400_0000
    UNKNOWN_TORQUE = 0x1000_0000
    UNKNOWN_VOLTAGE_COMMAND = 0x1_0000_0000
    UNBALANCED_PHASES = 0x8_0000_0000


class OdriveError(IntFlag):
    """`odrv.error`: disarms both axes; CANSimple 0.5 shows it as the motors' SYSTEM_LEVEL only."""

    NONE = 0
    CONTROL_ITERATION_MISSED = 0x01
    DC_BUS_UNDER_VOLTAGE = 0x02
    DC_BUS_OVER_VOLTAGE = 0x04
    DC_BUS_OVER_REGEN_CURRENT = 0x08
    DC_BUS_OVER_CURRENT = 0x10


class EncoderError(IntFlag):
    """The part of `encoder.error` that this project names."""

    NONE = 0
    CPR_POLEPAIRS_MISMATCH = 0x02
    NO_RESPONSE = 0x04
    ABS_SPI_COM_FAIL = 0x80


class ControllerError(IntFlag):
    """`controller.error`."""

    NONE = 0
    OVERSPEED = 0x01
    INVALID_INPUT_MODE = 0x02
    UNSTABLE_GAIN = 0x04
    INVALID_MIRROR_AXIS = 0x08
    INVALID_LOAD_ENCODER = 0x10
    INVALID_ESTIMATE = 0x20
    INVALID_CIRCULAR_RANGE = 0x40
    SPINOUT_DETECTED = 0x80


class Heartbeat(NamedTuple):
    """Payload of `Command.HEARTBEAT`."""

    axis_error: int
    axis_state: int
    motor_failed: bool
    encoder_failed: bool
    controller_failed: bool
    trajectory_done: bool

    @property
    def errors(self) -> int:
        """`axis_error`, with the three flags added as `AxisError` bits."""
        return (
            self.axis_error
            | self.motor_failed * AxisError.MOTOR_FAILED
            | self.encoder_failed * AxisError.ENCODER_FAILED
            | self.controller_failed * AxisError.CONTROLLER_FAILED
        )


_HEARTBEAT = Struct("<IBBBB")
_TRAJECTORY_DONE = 0x80
_U32, _F32, _TWO_I32, _TWO_F32 = Struct("<I"), Struct("<f"), Struct("<ii"), Struct("<ff")
_INPUT_POS = Struct("<fhh")
_MILLI = 1000.0
_I16_MAX = (1 << 15) - 1


def arbitration_id(node_id: int, command: int) -> int:
    """Return the 11-bit arbitration id of a command to or from a node (0 to 63)."""
    return (node_id & NODE_MASK) << COMMAND_BITS | command & COMMAND_MASK


def split_id(can_id: int) -> tuple[int, int]:
    """Return (node_id, command) of an 11-bit arbitration id."""
    return can_id >> COMMAND_BITS & NODE_MASK, can_id & COMMAND_MASK


def pack_heartbeat(heartbeat: Heartbeat) -> bytes:
    """Pack 0x001."""
    return _HEARTBEAT.pack(
        heartbeat.axis_error,
        heartbeat.axis_state,
        heartbeat.motor_failed,
        heartbeat.encoder_failed,
        heartbeat.controller_failed | heartbeat.trajectory_done * _TRAJECTORY_DONE,
    )


def unpack_heartbeat(data: bytes) -> Heartbeat:
    """Unpack 0x001."""
    axis_error, state, motor, encoder, controller = _HEARTBEAT.unpack_from(data)
    return Heartbeat(
        axis_error,
        state,
        bool(motor & 1),
        bool(encoder & 1),
        bool(controller & 1),
        bool(controller & _TRAJECTORY_DONE),
    )


pack_u32: Callable[[int], bytes] = _U32.pack
"""Pack one unsigned word: 0x004, 0x005, 0x006, 0x007 and 0x01D."""
pack_i32: Callable[[int], bytes] = Struct("<i").pack
"""Pack one signed word: 0x019 encoder counts."""
pack_motor_error: Callable[[int], bytes] = Struct("<Q").pack
"""Pack 0x003: 64 bits in firmware 0.5.6."""
pack_float: Callable[[float], bytes] = _F32.pack
"""Pack one number: 0x00E torque, 0x01A position gain."""
pack_two_floats: Callable[[float, float], bytes] = _TWO_F32.pack
"""Pack two numbers: 0x009 position and velocity; 0x00D velocity and torque; 0x00F velocity limit
and current limit; 0x014 Iq set and measured; 0x017 bus voltage and current; 0x01B velocity gain and
integrator gain."""
pack_two_ints: Callable[[int, int], bytes] = _TWO_I32.pack
"""Pack two signed words: 0x00A shadow count and count in turn, 0x00B control and input mode."""
unpack_two_floats: Callable[[bytes], tuple[float, float]] = _TWO_F32.unpack_from
unpack_two_ints: Callable[[bytes], tuple[int, int]] = _TWO_I32.unpack_from


def unpack_u32(data: bytes) -> int:
    """Unpack what `pack_u32` packs."""
    value: int = _U32.unpack_from(data)[0]
    return value


def unpack_float(data: bytes) -> float:
    """Unpack what `pack_float` packs."""
    value: float = _F32.unpack_from(data)[0]
    return value


def pack_input_pos(pos: float, vel: float, torque: float) -> bytes:
    """Pack 0x00C; vel and torque are sent as int16 in thousandths, saturated at 32.767."""
    return _INPUT_POS.pack(pos, _to_milli(vel), _to_milli(torque))


def unpack_input_pos(data: bytes) -> tuple[float, float, float]:
    """Unpack 0x00C into position, velocity and torque."""
    pos, vel, torque = _INPUT_POS.unpack_from(data)
    return pos, vel / _MILLI, torque / _MILLI


def _to_milli(value: float) -> int:
    """Return thousandths as the nearest int16."""
    return round(max(-_I16_MAX, min(_I16_MAX, value * _MILLI)))
