"""CANSimple 0.6: layouts against bytes written by hand from the published protocol page."""

from __future__ import annotations

import pytest

from shared.can import cansimple_06
from shared.can.cansimple import AxisState
from shared.can.cansimple_06 import (
    Command06,
    DriveError06,
    Heartbeat06,
    ProcedureResult,
    SdoOpcode,
    Version,
)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("GET_VERSION", 0x000),
        ("GET_ERROR", 0x003),
        ("RX_SDO", 0x004),
        ("TX_SDO", 0x005),
        ("ADDRESS", 0x006),
        ("GET_TEMPERATURE", 0x015),
        ("SET_ABSOLUTE_POSITION", 0x019),
        ("GET_TORQUES", 0x01C),
        ("GET_POWERS", 0x01D),
    ],
)
def test_command_has_the_number_of_the_page(name: str, number: int) -> None:
    assert Command06[name] == number


@pytest.mark.parametrize(
    ("error", "number"),
    [
        (DriveError06.DRV_FAULT, 32),
        (DriveError06.DC_BUS_OVER_VOLTAGE, 256),
        (DriveError06.DC_BUS_OVER_REGEN_CURRENT, 2048),
        (DriveError06.INVERTER_OVER_TEMP, 16_384),
        (DriveError06.VELOCITY_LIMIT_VIOLATION, 32_768),
        (DriveError06.WATCHDOG_TIMER_EXPIRED, 16_777_216),
        (DriveError06.ESTOP_REQUESTED, 33_554_432),
        (DriveError06.SPINOUT_DETECTED, 67_108_864),
    ],
)
def test_error_has_the_bit_of_the_published_dbc(error: DriveError06, number: int) -> None:
    assert error == number


HEARTBEAT = Heartbeat06(
    DriveError06.WATCHDOG_TIMER_EXPIRED,
    AxisState.IDLE,
    ProcedureResult.DISARMED,
    trajectory_done=True,
)
VERSION = Version(2, (4, 4, 58), (0, 6, 10), 0)


@pytest.mark.parametrize(
    ("packed", "by_hand"),
    [
        (cansimple_06.pack_heartbeat(HEARTBEAT), "00000001 01 03 01 00"),
        (cansimple_06.pack_version(VERSION), "02 04 04 3a 00 06 0a 00"),
        (cansimple_06.pack_error(0x20, 0x0100_0000), "20000000 00000001"),
        (cansimple_06.pack_sdo(SdoOpcode.WRITE, 0x0123, b"\x01\x02"), "01 2301 00 0102"),
    ],
)
def test_payload_has_these_bytes(packed: bytes, by_hand: str) -> None:
    assert packed == bytes.fromhex(by_hand)


def test_what_is_packed_comes_back() -> None:
    assert cansimple_06.unpack_heartbeat(cansimple_06.pack_heartbeat(HEARTBEAT)) == HEARTBEAT
    assert cansimple_06.unpack_version(cansimple_06.pack_version(VERSION)) == VERSION
    assert cansimple_06.unpack_error(cansimple_06.pack_error(1, 2)) == (1, 2)
    assert cansimple_06.unpack_sdo(cansimple_06.pack_sdo(0, 77, b"abcd")) == (0, 77, b"abcd")
