"""A drive whose phases are wired the other way, taken over while it holds, over USB."""

from __future__ import annotations

import pytest

from services.joint.drivers.base import DriveStatus
from services.joint.drivers.odrive_usb import OdriveUsb
from shared.config.robot_config import RobotConfig
from tests.usb.standin import MODULE, Control, UsbRobot, eventually, serial_number

pytest_plugins = ["tests.usb.fixtures"]
pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]

AXIS = 2 * MODULE + 1


@pytest.mark.parametrize("direction", [1, -1])
def test_a_drive_is_taken_over_with_its_torque_whichever_way_its_phases_are_wired(
    usb: UsbRobot, armed: Control, drive: OdriveUsb, config: RobotConfig, direction: int
) -> None:
    with usb.lock:
        usb.bank.settings.set(MODULE, "axis1.encoder.config.direction", direction)
        usb.bank.settings.fill("config.enable_watchdog", value=False)
    armed.target = (0.02, -0.03)
    assert eventually(lambda: usb.bank.torque[AXIS] == pytest.approx(-0.03))
    armed.stop()
    drive.close()
    with usb.lock:
        current = usb.bank.settings.current(AXIS, usb.bank.torque[AXIS])
    assert current * direction < 0.0, "what the drive shows"
    with Control(OdriveUsb(serial_number(MODULE), config.drive)).running() as heir:
        heir.target = None
        assert eventually(lambda: heir.status is DriveStatus.ARMED)
        assert heir.torque == pytest.approx((0.02, -0.03))
    heir.drive.close()
