"""The genuine odrive package and the driver on it, against emulated drives on a USB bus."""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from collections.abc import Iterator

import msgspec
import numpy as np
import odrive
import pytest

from services.joint.drivers import odrive_usb
from services.joint.drivers.base import DriveReading, MotorTarget
from services.joint.drivers.odrive_usb import EXCHANGE_HZ, OdriveUsb
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisError, AxisState, ControlMode
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tests.usb import standin
from tests.usb.standin import MODULE, Control, UsbRobot, eventually, serial_number

pytest_plugins = ["tests.usb.fixtures"]
pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]

AXES = slice(4, 6)
HOLD = MotorTarget((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (20.0, 20.0), (0.05, 0.05))


def is_status(reading: DriveReading | None, status: DriveStatus) -> bool:
    return reading is not None and reading.status is status


def test_the_genuine_package_reads_arms_streams_and_meets_a_disarm(usb: UsbRobot) -> None:
    board = odrive.find_sync(serial_number(MODULE), timeout=10)
    axes = (board.axis0, board.axis1)
    assert board.serial_number == standin.FIRST_SERIAL + MODULE
    assert board.vbus_voltage == pytest.approx(48.0, abs=0.1)

    for axis in axes:
        axis.config.enable_watchdog = False  # attributes one by one are slow on a busy machine
        axis.controller.config.vel_gain = 0.2
    board.clear_errors()
    for axis in axes:
        axis.requested_state = AxisState.CLOSED_LOOP_CONTROL
    assert [axis.current_state for axis in axes] == [AxisState.CLOSED_LOOP_CONTROL] * 2

    for set_point in np.linspace(0.0, 1.5, 100).tolist():
        for axis in axes:
            axis.controller.input_pos = set_point

        def follows(wanted: float = set_point) -> bool:
            return all(abs(axis.encoder.pos_estimate - wanted) < 0.1 for axis in axes)

        assert eventually(follows), "a machine that stalls makes no step of many set points"
    assert eventually(
        lambda: (
            axes[0].encoder.pos_estimate == pytest.approx(1.5, abs=1e-3)
            and axes[1].encoder.pos_estimate == pytest.approx(1.5, abs=1e-3)
        )
    )
    with usb.lock:
        assert usb.pos[AXES] == pytest.approx([1.5, 1.5], abs=1e-2)

    with usb.lock:
        usb.bank.inject(standin.axis_name(4), "OVERSPEED")
    assert [axis.current_state for axis in axes] == [
        AxisState.IDLE,
        AxisState.CLOSED_LOOP_CONTROL,
    ], "the sibling goes on"
    assert board.axis0.error & AxisError.CONTROLLER_FAILED
    assert board.axis0.controller.error == 1
    assert board.axis0.motor.error != 0


def test_arming_writes_the_limits_and_a_target_runs_the_drives_own_loop_until_idle(
    usb: UsbRobot, armed: Control, config: RobotConfig
) -> None:
    with usb.lock:
        assert usb.bank.vel_integrator_gain[AXES].tolist() == [0.0, 0.0]
        assert usb.bank.vel_limit[AXES].tolist() == [config.drive.vel_limit] * 2
        assert usb.bank.current_lim[AXES].tolist() == [config.drive.current_lim] * 2
        assert usb.bank.control_mode[AXES].tolist() == [ControlMode.POSITION] * 2
    armed.target = MotorTarget((0.5, -0.25), (0.0, 0.0), (0.02, 0.03), (20.0, 10.0), (0.2, 0.1))
    # At rest the feedforward is balanced by pos_gain vel_gain (input_pos - pos).
    rest = (0.5 + 0.02 / (20.0 * 0.2), -0.25 + 0.03 / (10.0 * 0.1))
    assert eventually(lambda: armed.pos == pytest.approx(rest, abs=1e-3))
    with usb.lock:
        assert usb.bank.input_torque[AXES] == pytest.approx([0.02, 0.03])
        assert usb.bank.pos_gain[AXES] == pytest.approx([20.0, 10.0])
        assert usb.bank.vel_gain[AXES] == pytest.approx([0.2, 0.1])
    armed.target = HOLD
    assert eventually(lambda: usb.bank.vel_gain[4] > 0)
    armed.target = (0.01, -0.02)
    assert eventually(lambda: usb.bank.vel_gain[AXES].tolist() == [0.0, 0.0])
    wanted = pytest.approx([0.01, -0.02])
    assert eventually(lambda: usb.bank.torque[AXES].tolist() == wanted)
    limit = config.drive.current_lim * config.drive.torque_constant
    armed.target = (1e3, -0.01)
    wanted = pytest.approx([limit, -0.01])
    assert eventually(lambda: usb.bank.input_torque[AXES].tolist() == wanted)
    with usb.lock:
        usb.bank.inject(standin.axis_name(5), "DISARM")
    armed.idle()
    assert eventually(lambda: usb.bank.state[4:6] == [AxisState.IDLE] * 2)
    assert eventually(lambda: armed.status is DriveStatus.IDLE)


def test_a_bad_target_is_not_sent_and_a_missing_drive_is_lost_without_an_exception(
    drive: OdriveUsb, usb: UsbRobot, config: RobotConfig
) -> None:
    assert eventually(lambda: is_status(drive.read(0.01), DriveStatus.IDLE))
    bad = itertools.product(HOLD.__struct_fields__, (math.nan, math.inf, 1e39, -1e300))
    for number, (field, value) in enumerate(bad, start=1):
        drive.write(msgspec.structs.replace(HOLD, **{field: (0.0, value)}))
        drive.write(HOLD)
        assert drive.write_failures == number, (field, value)
    drive.close()
    drive = OdriveUsb("000000000001", config.drive)
    for _ in range(20):
        reading = drive.read(0.01)
        assert reading is not None
        assert reading.status is DriveStatus.LOST
        drive.write_torque((1.0, 1.0))
    assert drive.write_failures == 20
    drive.close()


def test_samples_come_at_the_exchange_rate_and_a_written_position_is_taken(
    control: Control, usb: UsbRobot
) -> None:
    with usb.lock:
        usb.pos[:] = np.arange(12) / 4
    assert eventually(lambda: control.pos == (1.0, 1.25)), "by its serial number"
    before = control.samples
    time.sleep(1.0)
    assert 0.25 * EXCHANGE_HZ < control.samples - before < 1.1 * EXCHANGE_HZ
    control.drive.set_position((64.25, -3.5))
    assert eventually(lambda: control.pos == (64.25, -3.5))
    with usb.lock:
        assert usb.pos[AXES].tolist() == [1.0, 1.25]


def test_an_axis_that_disarms_is_an_error_with_or_without_an_error_bit_until_it_is_armed_again(
    usb: UsbRobot, armed: Control
) -> None:
    armed.target = (0.001, 0.001)
    for fault in ("DISARM", "OVERSPEED", "ENCODER", "OVER_TEMP"):
        with usb.lock:
            usb.bank.inject(standin.axis_name(4), fault)
        assert eventually(lambda: armed.status is DriveStatus.ERROR), fault
        assert (armed.error == 0) == (fault == "DISARM")
        with usb.lock:
            assert usb.bank.state[4:6] == [AxisState.IDLE, AxisState.CLOSED_LOOP_CONTROL]
        armed.arm()
        assert eventually(lambda: armed.status is DriveStatus.ARMED), fault


def test_a_drive_found_armed_reports_its_torque_until_it_is_taken_over(
    usb: UsbRobot, armed: Control, drive: OdriveUsb, config: RobotConfig
) -> None:
    armed.target = (0.02, -0.03)
    assert eventually(lambda: usb.bank.torque[5] == pytest.approx(-0.03))
    armed.stop()
    with usb.lock:
        usb.bank.settings.fill("config.enable_watchdog", value=False)
    drive.close()
    heir = Control(OdriveUsb(serial_number(MODULE), config.drive))
    heir.target = None
    with heir.running():
        assert eventually(lambda: heir.torque is not None)
        for _ in range(10):  # in every sample: a service waits on it until a planner is heard
            before = heir.samples
            assert eventually(lambda before=before: heir.samples > before)
            assert heir.torque == pytest.approx((0.02, -0.03))
        assert heir.status is DriveStatus.ARMED
        heir.target = (0.01, 0.01)
        assert eventually(lambda: usb.bank.torque[5] == pytest.approx(0.01))
        assert eventually(lambda: heir.torque is None)
    heir.drive.close()


def test_no_reading_after_arm_reports_the_error_before(
    usb: UsbRobot, armed: Control, drive: OdriveUsb, monkeypatch: pytest.MonkeyPatch
) -> None:
    carry_out = drive._carry_out

    async def carry_out_and_hang(*request: object) -> None:
        await carry_out(*request)
        usb.stalled.set()
        await asyncio.sleep(0.05)  # until the board sees it

    with usb.lock:
        usb.bank.inject(standin.axis_name(4), "OVERSPEED")
    assert eventually(lambda: armed.status is DriveStatus.ERROR)
    armed.stop()
    assert eventually(drive._fresh.is_set), "a sample with the error waits"
    monkeypatch.setattr(drive, "_carry_out", carry_out_and_hang)
    drive.arm(onboard=True)
    assert eventually(usb.stalled.is_set)
    assert is_status(drive.read(0.0), DriveStatus.IDLE)
    usb.stalled.clear()


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e39])
def test_a_position_that_is_no_count_is_refused_and_the_drive_stays(
    control: Control, drive: OdriveUsb, bad: float
) -> None:
    with pytest.raises(DriveError, match="are not valid positions"):
        control.drive.set_position((bad, 0.0))
    control.drive.set_position((1.0, 1.0))
    assert eventually(lambda: control.pos == (1.0, 1.0))
    assert drive.connections == 1


def test_an_idle_drive_has_an_encoder_zero_and_no_torque_when_armed_before_a_target(
    drive: OdriveUsb, usb: UsbRobot
) -> None:
    assert eventually(lambda: (reading := drive.read(0.01)) and reading.encoder_zero is not None)
    with usb.lock:
        usb.pos[AXES] = (0.7, -0.3)
    assert eventually(lambda: is_status(drive.read(0.01), DriveStatus.IDLE))
    drive.arm(onboard=True)
    assert eventually(lambda: is_status(drive.read(0.01), DriveStatus.ARMED))
    with usb.lock:
        assert usb.bank.torque[AXES].tolist() == [0.0, 0.0]
        assert usb.pos[AXES].tolist() == [0.7, -0.3]


def test_a_control_loop_that_hangs_lets_the_watchdog_fire(usb: UsbRobot, armed: Control) -> None:
    time.sleep(odrive_usb.FEED_MS * 1e-3)
    assert armed.status is DriveStatus.ARMED
    armed.hang.set()
    assert eventually(lambda: usb.bank.state[4:6] == [AxisState.IDLE] * 2)
    with usb.lock:
        assert usb.bank.faults[4].axis & AxisError.WATCHDOG_TIMER_EXPIRED


def test_close_carries_out_the_last_idle_and_leaves_no_task(
    usb: UsbRobot, armed: Control, drive: OdriveUsb
) -> None:
    armed.stop()
    drive.idle()
    drive.close()
    with usb.lock:
        assert usb.bank.state[4:6] == [AxisState.IDLE] * 2
    assert drive._task.done()
    assert not drive._manager._device_metadata, "another program may have the drive"
    drive.close()


def told_in_state(usb: UsbRobot, monkeypatch: pytest.MonkeyPatch) -> list[AxisState]:
    """Return a list that fills with the states in which axes get their positions."""
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
    """An armed axis would jump by what it gets: 64 turns where a lost zero is forgotten."""
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


def test_a_pulled_plug_is_lost_comes_back_and_leaves_the_other_drives_alone(
    usb: UsbRobot, control: Control, drive: OdriveUsb, config: RobotConfig
) -> None:
    for turn in (2, 3):
        plug(usb, up=False)
        assert eventually(lambda: control.status is LOST)
        plug(usb, up=True)
        assert eventually(lambda: control.status is DriveStatus.IDLE)
        assert drive.connections == turn
    assert control.raised is None
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


def test_silence_counts_only_while_somebody_reads_and_not_at_once(
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
    usb.stalled.set()
    readings = [patient.read(0.02) for _ in range(50)]
    usb.stalled.clear()
    silence = readings[readings.index(None) :]
    assert [reading for reading in silence if reading is not None], "it is lost in the end"
    assert all(reading is None or reading.status == LOST for reading in silence)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_drive_is_taken_over_with_its_torque_whichever_way_its_phases_are_wired(
    usb: UsbRobot, armed: Control, drive: OdriveUsb, config: RobotConfig, direction: int
) -> None:
    with usb.lock:
        usb.bank.settings.set(MODULE, "axis1.encoder.config.direction", direction)
        usb.bank.settings.fill("config.enable_watchdog", value=False)
    armed.target = (0.02, -0.03)
    assert eventually(lambda: usb.bank.torque[5] == pytest.approx(-0.03))
    armed.stop()
    drive.close()
    with usb.lock:
        current = usb.bank.settings.current(5, usb.bank.torque[5])
    assert current * direction < 0.0, "what the drive shows"
    with Control(OdriveUsb(serial_number(MODULE), config.drive)).running() as heir:
        heir.target = None
        assert eventually(lambda: heir.status is DriveStatus.ARMED)
        assert heir.torque == pytest.approx((0.02, -0.03))
    heir.drive.close()
