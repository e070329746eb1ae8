"""The USB driver asked for several things at once, and in the log when it finds nothing."""

from __future__ import annotations

import logging
import time

import pytest

from services.joint.drivers import odrive_usb
from services.joint.drivers.base import DriveStatus, MotorTarget
from services.joint.drivers.odrive_usb import OdriveUsb
from shared.can.cansimple import AxisState
from shared.config.robot_config import RobotConfig
from tests.usb.standin import MODULE, Control, UsbRobot, eventually, serial_number

pytest_plugins = ["tests.usb.fixtures"]
pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]

HOLD = MotorTarget((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (20.0, 20.0), (0.05, 0.05))


def told_in_state(usb: UsbRobot, monkeypatch: pytest.MonkeyPatch) -> list[AxisState]:
    """Return a list that fills with the states in which axes are told their positions."""
    states: list[AxisState] = []
    set_count = usb.bank.set_count

    def spy(axis: int, count: float) -> None:
        states.append(usb.bank.state[axis])
        set_count(axis, count)

    monkeypatch.setattr(usb.bank, "set_count", spy)
    return states


def test_a_position_set_right_after_idle_finds_both_axes_idle(
    usb: UsbRobot, armed: Control, drive: OdriveUsb, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An armed axis would jump by what it is told: 64 turns where a lost zero is forgotten."""
    armed.target = HOLD
    assert eventually(lambda: usb.bank.vel_gain[4] > 0.0)
    states = told_in_state(usb, monkeypatch)
    armed.stop()
    drive.idle()
    drive.set_position((-64.0, -64.0))
    assert eventually(lambda: len(states) == 2)
    assert states == [AxisState.IDLE] * 2


def test_a_position_set_right_before_arm_comes_before_it(
    usb: UsbRobot, control: Control, drive: OdriveUsb, monkeypatch: pytest.MonkeyPatch
) -> None:
    states = told_in_state(usb, monkeypatch)
    control.stop()
    drive.set_position((0.5, 0.25))
    drive.arm(onboard=True)
    closed = AxisState.CLOSED_LOOP_CONTROL
    assert eventually(lambda: usb.bank.state[4:6] == [closed] * 2)
    assert states == [AxisState.IDLE] * 2
    assert usb.bank.input_pos[4:6].tolist() == pytest.approx([0.5, 0.25], abs=1e-3)


def test_a_drive_missing_from_the_bus_is_reported_once_with_its_number(
    usb: UsbRobot,
    config: RobotConfig,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(odrive_usb, "REPORT_S", 0.1)
    with caplog.at_level(logging.WARNING, "xrl"):
        drive = OdriveUsb("0000000000AB", config.drive)
        assert eventually(lambda: bool(caplog.records))
        time.sleep(0.5)
        drive.close()
    assert [record.getMessage().split(";")[0] for record in caplog.records] == [
        "ODrive 0000000000AB: not on USB"
    ]


def test_a_drive_that_is_present_is_not_reported(
    usb: UsbRobot,
    config: RobotConfig,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING, "xrl"):
        drive = OdriveUsb(serial_number(MODULE), config.drive)
        assert eventually(
            lambda: (
                (reading := drive.read(0.01)) is not None and reading.status is not DriveStatus.LOST
            )
        )
        drive.close()
    assert not caplog.records
