"""CANSimple 0.5.6 and 0.6: layouts against bytes written by hand from the published protocols.

Of 0.5.6 can-protocol and can_simple.cpp; of 0.6 the protocol page and the .dbc.
"""

from __future__ import annotations

import math
from enum import Enum, IntEnum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.can import cansimple, cansimple_06
from shared.can.cansimple import AxisError, AxisState, Command, Heartbeat
from shared.can.cansimple_06 import (
    Command06,
    DriveError06,
    Heartbeat06,
    ProcedureResult,
    SdoOpcode,
    Version,
)

float32 = st.floats(width=32, allow_nan=False)
HEARTBEAT_06 = Heartbeat06(
    DriveError06.WATCHDOG_TIMER_EXPIRED, AxisState.IDLE, ProcedureResult.DISARMED, True
)
VERSION = Version(2, (4, 4, 58), (0, 6, 10), 0)

NUMBERS: dict[type[IntEnum], dict[str, int]] = {
    Command: {
        "HEARTBEAT": 0x001, "ESTOP": 0x002, "GET_MOTOR_ERROR": 0x003, "GET_ENCODER_ERROR": 0x004,
        "SET_AXIS_STATE": 0x007, "GET_ENCODER_ESTIMATES": 0x009, "GET_ENCODER_COUNT": 0x00A,
        "SET_CONTROLLER_MODE": 0x00B, "SET_INPUT_POS": 0x00C, "SET_INPUT_VEL": 0x00D,
        "SET_INPUT_TORQUE": 0x00E, "SET_LIMITS": 0x00F, "GET_IQ": 0x014, "REBOOT": 0x016,
        "GET_VBUS": 0x017, "CLEAR_ERRORS": 0x018, "SET_POS_GAIN": 0x01A, "SET_VEL_GAINS": 0x01B,
        "GET_CONTROLLER_ERROR": 0x01D,
    },
    Command06: {
        "GET_VERSION": 0x000, "GET_ERROR": 0x003, "RX_SDO": 0x004, "TX_SDO": 0x005,
        "ADDRESS": 0x006, "GET_TEMPERATURE": 0x015, "SET_ABSOLUTE_POSITION": 0x019,
        "GET_TORQUES": 0x01C, "GET_POWERS": 0x01D,
    },
    DriveError06: {  # type: ignore[dict-item]  # flags are integers as well
        "DRV_FAULT": 32, "DC_BUS_OVER_VOLTAGE": 256, "DC_BUS_OVER_REGEN_CURRENT": 2048,
        "INVERTER_OVER_TEMP": 16_384, "VELOCITY_LIMIT_VIOLATION": 32_768,
        "WATCHDOG_TIMER_EXPIRED": 16_777_216, "ESTOP_REQUESTED": 33_554_432,
        "SPINOUT_DETECTED": 67_108_864,
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", NUMBERS)
def test_commands_and_errors_have_the_numbers_of_the_documents(kind: type[IntEnum]) -> None:
    assert {name: int(kind[name]) for name in NUMBERS[kind]} == NUMBERS[kind]


@pytest.mark.parametrize(
    ("ours", "name"),
    [(DriveError06, "ODriveError"), (ProcedureResult, "ProcedureResult"), (AxisState, "AxisState")],
)
def test_what_0_6_reports_is_named_as_in_the_odrive_package(ours: type[Enum], name: str) -> None:
    enums = pytest.importorskip("odrive.enums")
    theirs = {each.name: each.value for each in getattr(enums, name).__members__.values()}
    assert {each.name: each.value for each in ours.__members__.values()} == theirs


def test_arbitration_id_is_node_times_32_plus_command() -> None:
    assert cansimple.arbitration_id(3, Command.SET_INPUT_TORQUE) == 0x06E
    assert cansimple.arbitration_id(63, 0x1F) == 0x7FF
    assert cansimple.split_id(0x06E) == (3, Command.SET_INPUT_TORQUE)


@pytest.mark.parametrize(
    ("packed", "by_hand"),
    [
        (cansimple.pack_u32(AxisState.CLOSED_LOOP_CONTROL), "08000000"),
        (cansimple.pack_two_floats(1.5, -2.0), "0000c03f 000000c0"),
        (cansimple.pack_float(-0.25), "000080be"),
        (cansimple.pack_i32(-2), "feffffff"),
        (cansimple.pack_two_ints(1, -2), "01000000 feffffff"),
        (cansimple.pack_input_pos(1.5, 1.0, -0.5), "0000c03f e803 0cfe"),
        (cansimple.pack_motor_error(0x2_0000_0001), "01000000 02000000"),
        (cansimple.pack_heartbeat(Heartbeat(0x800, 8, True, False, True, True)),
         "00080000 08 01 00 81"),
        (cansimple_06.pack_heartbeat(HEARTBEAT_06), "00000001 01 03 01 00"),
        (cansimple_06.pack_version(VERSION), "02 04 04 3a 00 06 0a 00"),
        (cansimple_06.pack_error(0x20, 0x0100_0000), "20000000 00000001"),
        (cansimple_06.pack_sdo(SdoOpcode.WRITE, 0x0123, b"\x01\x02"), "01 2301 00 0102"),
    ],
)  # fmt: skip
def test_payload_equals_the_bytes_written_by_hand(packed: bytes, by_hand: str) -> None:
    assert packed == bytes.fromhex(by_hand)


def test_heartbeat_is_read_from_bytes_written_by_hand() -> None:
    heartbeat = cansimple.unpack_heartbeat(bytes.fromhex("40000000 01 01 01 80"))
    assert heartbeat == Heartbeat(AxisError.MOTOR_FAILED, AxisState.IDLE, True, True, False, True)


def test_heartbeat_flags_count_as_errors_when_axis_error_is_zero() -> None:
    heartbeat = Heartbeat(0, AxisState.IDLE, True, False, True, False)
    assert heartbeat.errors == AxisError.MOTOR_FAILED | AxisError.CONTROLLER_FAILED
    assert Heartbeat(0, AxisState.IDLE, False, False, False, True).errors == 0


@given(float32, float32)
def test_two_floats_survive_the_round_trip(first: float, second: float) -> None:
    data = cansimple.pack_two_floats(first, second)
    assert cansimple.unpack_two_floats(data) == (first, second)


@given(st.integers(0, 2**32 - 1), st.sampled_from(AxisState), st.tuples(*[st.booleans()] * 4))
def test_heartbeat_survives_the_round_trip(
    error: int, state: AxisState, flags: tuple[bool, bool, bool, bool]
) -> None:
    heartbeat = Heartbeat(error, state, *flags)
    assert cansimple.unpack_heartbeat(cansimple.pack_heartbeat(heartbeat)) == heartbeat


def test_what_is_packed_for_0_6_comes_back() -> None:
    assert cansimple_06.unpack_heartbeat(cansimple_06.pack_heartbeat(HEARTBEAT_06)) == HEARTBEAT_06
    assert cansimple_06.unpack_version(cansimple_06.pack_version(VERSION)) == VERSION
    assert cansimple_06.unpack_sdo(cansimple_06.pack_sdo(0, 77, b"abcd")) == (0, 77, b"abcd")


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_feedforward_of_input_pos_saturates_and_never_wraps(vel: float, torque: float) -> None:
    _, vel_back, torque_back = cansimple.unpack_input_pos(cansimple.pack_input_pos(0, vel, torque))
    for asked, got in ((vel, vel_back), (torque, torque_back)):
        assert math.isclose(got, max(-32.767, min(32.767, asked)), abs_tol=0.0006)
