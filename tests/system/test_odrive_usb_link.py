"""The USB driver when its link fails: plugs, power, boards that hang, boards of another kind."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from services.joint.drivers.base import DriveStatus
from services.joint.drivers.odrive_usb import OdriveUsb
from services.simulator.fronts import fibre_front
from services.simulator.fronts.fibre_front import endpoints
from shared.can.cansimple import AxisState
from shared.config.robot_config import RobotConfig
from tests.usb.standin import MODULE, Control, UsbRobot, eventually, serial_number

pytest_plugins = ["tests.usb.fixtures"]
pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]

LOST = DriveStatus.LOST


def plug(usb: UsbRobot, *, up: bool) -> None:
    with usb.lock:
        usb.bank.conditions.link(MODULE, up=up)


@pytest.fixture
def patient(usb: UsbRobot, config: RobotConfig) -> Iterator[OdriveUsb]:
    """Return the driver of a drive without a watchdog, which answers."""
    off = msgspec.structs.replace(config.drive, watchdog_timeout=0.0)
    drive = OdriveUsb(serial_number(MODULE), off)
    assert eventually(lambda: answers(drive))
    yield drive
    drive.close()


def answers(drive: OdriveUsb) -> bool:
    reading = drive.read(0.01)
    return reading is not None and reading.status is not LOST


def test_a_pulled_plug_is_lost_and_the_drive_comes_back_by_itself(
    usb: UsbRobot, control: Control, drive: OdriveUsb
) -> None:
    for turn in (2, 3):
        plug(usb, up=False)
        assert eventually(lambda: control.status is LOST)
        plug(usb, up=True)
        assert eventually(lambda: control.status is DriveStatus.IDLE)
        assert drive.connections == turn
    assert control.raised is None


def test_the_other_drives_go_on_while_one_is_unplugged(
    usb: UsbRobot, control: Control, config: RobotConfig
) -> None:
    other = OdriveUsb(serial_number(0), config.drive)
    with Control(other).running() as sibling:
        assert eventually(lambda: sibling.status is DriveStatus.IDLE)
        plug(usb, up=False)
        assert eventually(lambda: control.status is LOST)
        before = sibling.samples
        assert eventually(lambda: sibling.samples > before + 10)
        assert other.connections == 1
    other.close()


def test_a_drive_that_lost_its_power_is_an_error_and_stays_disarmed(
    usb: UsbRobot, armed: Control, drive: OdriveUsb
) -> None:
    with usb.lock:
        usb.bank.reboot(4)
    assert eventually(lambda: drive.connections == 2)
    assert eventually(lambda: armed.status is DriveStatus.ERROR)
    with usb.lock:
        assert AxisState.CLOSED_LOOP_CONTROL not in usb.bank.state[4:6]


@pytest.mark.parametrize("asked", ["arm", "idle"])
def test_what_was_asked_of_a_lost_drive_is_forgotten_when_it_returns(
    usb: UsbRobot, armed: Control, drive: OdriveUsb, asked: str
) -> None:
    with usb.lock:  # a drive that holds by its own loop
        usb.bank.settings.fill("config.enable_watchdog", value=False)
    if asked == "arm":
        armed.idle()
        assert eventually(lambda: armed.status is DriveStatus.IDLE)
    before = usb.bank.state[4:6]
    plug(usb, up=False)
    assert eventually(lambda: armed.status is LOST)
    getattr(armed, asked)()
    time.sleep(0.05)
    plug(usb, up=True)
    assert eventually(lambda: armed.status is not LOST)
    samples = armed.samples
    assert eventually(lambda: armed.samples > samples + 20)
    with usb.lock:
        assert usb.bank.state[4:6] == before


def test_a_drive_that_holds_gets_no_target_of_before_its_link_was_lost(
    usb: UsbRobot, armed: Control, drive: OdriveUsb
) -> None:
    armed.target = (0.001, 0.002)
    assert eventually(lambda: usb.bank.input_torque[5] == pytest.approx(0.002))
    with usb.lock:
        usb.bank.settings.fill("config.enable_watchdog", value=False)
        usb.bank.conditions.link(MODULE, up=False)
    assert eventually(lambda: armed.status is LOST)
    armed.target = None
    with usb.lock:
        usb.bank.input_torque[4:6] = (0.003, 0.004)
        usb.bank.conditions.link(MODULE, up=True)
    assert eventually(lambda: armed.status is DriveStatus.ARMED)
    samples = armed.samples
    assert eventually(lambda: armed.samples > samples + 20)
    with usb.lock:
        assert usb.bank.input_torque[4:6].tolist() == [0.003, 0.004]


def test_no_call_waits_for_a_board_that_hangs(
    usb: UsbRobot, armed: Control, drive: OdriveUsb
) -> None:
    armed.longest_s = 0.0
    usb.stalled.set()
    assert eventually(lambda: armed.status is LOST)
    time.sleep(1.2)  # two transfer timeouts
    usb.stalled.clear()
    assert eventually(lambda: drive.connections == 2)
    assert eventually(lambda: armed.status is not LOST)
    assert armed.longest_s < 0.4, "the package's transfer timeout is 0.5 s"
    assert armed.raised is None


def test_a_drive_without_a_watchdog_is_not_lost_at_the_first_silence(
    usb: UsbRobot, patient: OdriveUsb
) -> None:
    usb.stalled.set()
    readings = [patient.read(0.02) for _ in range(50)]
    usb.stalled.clear()
    silence = readings[readings.index(None) :]
    assert [reading for reading in silence if reading is not None], "it is lost in the end"
    assert all(reading is None or reading.status == LOST for reading in silence)


def test_silence_without_a_reader_does_not_count_against_the_drive(
    usb: UsbRobot, patient: OdriveUsb
) -> None:
    """As when the service is stopped and continued: it has heard nothing because it slept."""
    usb.stalled.set()
    time.sleep(0.25)
    heard = patient.read(0.01)
    assert heard is None or heard.status is not LOST, "of before the silence"
    assert patient.read(0.01) is None
    usb.stalled.clear()
    assert eventually(lambda: answers(patient))
    assert patient.connections == 1


def test_a_board_that_is_no_v3_is_named_in_trouble(
    libusb: None, config: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    single = [row for row in endpoints() if not row.name.startswith("axis1")]
    monkeypatch.setattr(fibre_front, "endpoints", lambda: single)
    monkeypatch.setenv("XRL_USB", str(tmp_path))
    with UsbRobot(config, tmp_path).running():
        drive = OdriveUsb(serial_number(MODULE), config.drive)
        assert eventually(lambda: "axis1.encoder.pos_estimate" in drive.trouble)
        assert "firmware 0.5.x" in drive.trouble
        reading = drive.read(0.0)
        assert reading is not None
        assert reading.status is LOST
        drive.close()
