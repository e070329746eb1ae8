"""Boards over USB by the genuine package, on the stand-in of libusb."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.can.cansimple import AxisState
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tests.usb.standin import MODULE, UsbRobot, eventually, serial_number
from tools.bringup import usb_board
from tools.bringup.boards import STATUS
from tools.bringup.usb_board import UsbBoard, UsbBus

pytest_plugins = ["tests.usb.fixtures"]
pytestmark = [pytest.mark.system, pytest.mark.timeout(90)]

VEL_LIMIT = "axis1.controller.config.vel_limit"
AXIS = 2 * MODULE + 1


@pytest.fixture
def bus(usb: UsbRobot) -> Iterator[UsbBus]:
    bus = UsbBus()
    yield bus
    bus.close()


@pytest.fixture
def board(bus: UsbBus) -> UsbBoard:
    found = bus.open([serial_number(MODULE)])
    assert found.troubles == {}
    board = found.boards[serial_number(MODULE)]
    assert isinstance(board, UsbBoard)
    return board


def test_boards_are_found_by_serial_number_and_strangers_are_named(bus: UsbBus) -> None:
    wanted = [serial_number(0), serial_number(1).lower(), "0000000000FF"]
    found = bus.open(wanted, timeout_s=1.0)
    assert sorted(found.boards) == [serial_number(0), serial_number(1)]
    assert "not plugged in" in found.troubles["0000000000FF"]
    assert set(found.strangers) == {serial_number(module) for module in range(2, 6)}
    assert {board.firmware for board in found.boards.values()} == {(0, 5, 6)}


def test_settings_and_status_are_read_and_what_is_not_there_is_left_out(
    board: UsbBoard, config: RobotConfig
) -> None:
    settings = board.read(board.settings)
    assert settings[VEL_LIMIT] == config.drive.vel_limit
    assert settings["config.dc_max_positive_current"] == math.inf
    assert settings["axis0.config.enable_watchdog"] is True
    status = board.read([*STATUS, "axis7.error"])
    assert set(STATUS) - set(status) == {"brake_resistor_armed"}, "the emulator has no such thing"
    assert status["vbus_voltage"] == pytest.approx(48.0, abs=0.1)
    assert board.states() == (AxisState.IDLE, AxisState.IDLE)


def test_what_is_written_is_lost_by_a_restart_and_what_is_saved_is_not(
    usb: UsbRobot, board: UsbBoard
) -> None:
    board.write({VEL_LIMIT: 7.5, "axis0.config.enable_watchdog": False})
    board.save()
    assert board.read([VEL_LIMIT])[VEL_LIMIT] == 7.5
    board.write({VEL_LIMIT: 3.5})
    board.restart()
    assert board.read([VEL_LIMIT])[VEL_LIMIT] == 7.5


def test_errors_of_both_axes_are_cleared(usb: UsbRobot, board: UsbBoard) -> None:
    board.write({f"axis{i}.config.enable_watchdog": False for i in (0, 1)})
    with usb.lock:
        usb.bank.estop(AXIS)
        usb.bank.estop(AXIS - 1)
    board.clear_errors()
    assert board.read(["axis0.error", "axis1.error"]) == {"axis0.error": 0, "axis1.error": 0}


def test_a_name_that_the_board_does_not_have_is_refused_before_anything_is_written(
    usb: UsbRobot, board: UsbBoard
) -> None:
    before = usb.bank.settings.get(MODULE, VEL_LIMIT)
    with pytest.raises(DriveError, match=r"firmware 0\.5\.6: has no axis0\.nothing"):
        board.write({VEL_LIMIT: 1.0, "axis0.nothing": 1.0})
    assert usb.bank.settings.get(MODULE, VEL_LIMIT) == before


def test_a_board_that_does_not_restart_is_an_error_and_not_a_success(
    usb: UsbRobot, board: UsbBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when an axis is armed: the firmware then does not save."""
    monkeypatch.setattr(usb_board, "LEAVE_S", 0.5)
    with usb.lock:
        usb.bank.settings.fill("config.enable_watchdog", value=False)
        usb.bank.clear_errors(AXIS)  # it may have run out by now
        usb.bank.request_state(AXIS, AxisState.CLOSED_LOOP_CONTROL)
        assert usb.bank.state[AXIS] == AxisState.CLOSED_LOOP_CONTROL
    with pytest.raises(DriveError, match="armed"):
        board.save()


def test_a_board_that_hangs_or_is_unplugged_is_an_error_in_time(
    usb: UsbRobot, board: UsbBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    usb.stalled.set()
    time.sleep(0.1)  # its last round is over
    with pytest.raises(DriveError, match=serial_number(MODULE)):
        board.read([VEL_LIMIT])
    usb.stalled.clear()
    with usb.lock:
        usb.bank.conditions.link(MODULE, up=False)
    assert eventually(lambda: not (Path(usb.ports[MODULE].path).exists()))
    with pytest.raises(DriveError, match=serial_number(MODULE)):
        board.read([VEL_LIMIT])
