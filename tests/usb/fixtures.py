"""Fixtures: a USB bus with six emulated drives, the driver on one of them, a control loop on it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from services.joint.drivers.odrive_usb import OdriveUsb
from shared.bus.messages import DriveStatus
from shared.config.robot_config import RobotConfig
from tests.usb import standin
from tests.usb.standin import MODULE, Control, UsbRobot, eventually, serial_number


@pytest.fixture(scope="session")
def libusb(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Put the stand-in in the place of libusb, and the package's cache aside, for all tests."""
    folder = tmp_path_factory.mktemp("libusb")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        standin.load(standin.build(folder))
        yield


@pytest.fixture(scope="session")
def config(robot: RobotConfig) -> RobotConfig:
    """Return the shipped robot with the drives' watchdogs on.

    They are five times as patient as a robot's: a busy machine stalls for more than 0.1 s.
    """
    drive = msgspec.structs.replace(robot.drive, watchdog_timeout=0.5, zero_mark_turns=0.0)
    return msgspec.structs.replace(robot, drive=drive)


@pytest.fixture
def usb(
    libusb: None, config: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[UsbRobot]:
    """Return six drives on a bus of their own."""
    monkeypatch.setenv("XRL_USB", str(tmp_path))
    with UsbRobot(config, tmp_path).running() as drives:
        yield drives


@pytest.fixture
def drive(usb: UsbRobot, config: RobotConfig) -> Iterator[OdriveUsb]:
    drive = OdriveUsb(serial_number(MODULE), config.drive)
    yield drive
    drive.close()


@pytest.fixture
def control(drive: OdriveUsb) -> Iterator[Control]:
    """Return a control loop on the drive, connected and not armed."""
    with Control(drive).running() as control:
        assert eventually(lambda: control.status is DriveStatus.IDLE), drive.trouble
        yield control


@pytest.fixture
def armed(control: Control) -> Control:
    """Return the control loop with the drive armed."""
    control.arm()
    assert eventually(lambda: control.status is DriveStatus.ARMED)
    return control
