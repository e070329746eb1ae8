"""The CAN driver against the emulated drives, with time made by the test on the drives' side."""

from __future__ import annotations

import math
import shutil
import struct
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from services.joint.drivers.base import Drive, DriveReading, DriveStatus
from services.joint.drivers.odrive_can import ARM_GRACE_MS, RETRY_MS, OdriveCan
from services.simulator.axis_bank import AxisBank
from services.simulator.cansimple_dialects import DialectName
from services.simulator.cansimple_front import CanSimpleFront
from services.simulator.unix_can_hub import UnixCanHub
from shared.can.cansimple import AxisError, AxisState, Command, arbitration_id, pack_two_floats
from shared.can.unix_can import UnixCanBus
from shared.config.sections import CanConfig, DriveConfig
from shared.exceptions import DriveError

DRIVE = DriveConfig(
    torque_constant=0.0827,
    current_lim=60.0,
    vel_limit=60.0,
    dc_max_negative_current=-30.0,
    watchdog_timeout=0.1,
    encoder_period_ms=1,
    heartbeat_period_ms=1,  # so that a state is known one step later
    zero_mark_turns=0.0,
)
NODES = (4, 5)
AXES = (4, 5)
MS = 1e-3


class Rig:
    """An emulated ODrive, hip_right of the bank, on a hub; `step` is one millisecond of it."""

    def __init__(
        self,
        path: Path,
        *,
        watchdog: bool = False,
        dialect: DialectName = "0.5",
        hub: type[UnixCanHub] = UnixCanHub,
    ) -> None:
        self.hub = hub(path)
        self.bank = AxisBank(DRIVE, encoder_counts_per_turn=16384, watchdog=watchdog)
        self.front = CanSimpleFront(
            self.bank,
            [self.hub],
            [dict(zip(NODES, AXES, strict=True))],
            heartbeat_period_ms=1,
            dialect=dialect,
        )
        self.pos = np.zeros(12)
        self.vel = np.zeros(12)
        self.now_s = 0.0

    def step(self) -> np.ndarray:
        self.front.receive()
        torque = self.bank.step(self.now_s, self.pos, self.vel)
        self.front.send_encoders()
        self.front.send_heartbeats(self.now_s)
        self.now_s += MS
        return torque

    def cycle(self, driver: OdriveCan) -> DriveReading:
        """Step, read twice what the step sent, so that its heartbeats are in, and return it."""
        self.step()
        first = driver.read(0.5)
        assert first is not None
        self.step()
        second = driver.read(0.5)
        assert second is not None
        return second


@pytest.fixture
def path() -> Iterator[Path]:
    directory = Path(tempfile.mkdtemp(dir="/tmp"))
    yield directory / "can.sock"
    shutil.rmtree(directory)


@pytest.fixture
def rig(path: Path) -> Iterator[Rig]:
    rig = Rig(path)
    yield rig
    rig.hub.close()


@pytest.fixture
def driver(path: Path) -> Iterator[OdriveCan]:
    driver = make_driver(path)
    yield driver
    driver.close()


def make_driver(path: Path) -> OdriveCan:
    config = CanConfig(interface="xrl_unix", channel=str(path))
    return OdriveCan(config, NODES, DRIVE, encoder_counts_per_turn=16384)


def arm(rig: Rig, driver: OdriveCan) -> None:
    """Arm and wait out the time in which heartbeats are not believed."""
    driver.arm(onboard=False)
    time.sleep((ARM_GRACE_MS + 5) * MS)
    reading = rig.cycle(driver)
    assert reading.status == DriveStatus.ARMED
    assert reading.error == 0


def connected(rig: Rig, path: Path) -> OdriveCan:
    driver = make_driver(path)
    assert rig.cycle(driver).status == DriveStatus.IDLE
    return driver


def test_driver_is_a_drive(rig: Rig, driver: OdriveCan) -> None:
    drive: Drive = driver
    assert drive.read(0.0) is not None


def test_reading_holds_the_positions_and_velocities_of_both_axes(rig: Rig, path: Path) -> None:
    rig.pos[[4, 5]] = 1.5, -2.25
    rig.vel[[4, 5]] = 3.0, -4.0
    rig.bank.connected[:] = 1.0  # as after a first closed loop: before it 0.5.6 says zeros
    driver = make_driver(path)
    rig.step()
    reading = driver.read(0.5)
    driver.close()
    assert reading is not None
    assert reading.pos_turns == (1.5, -2.25)
    assert reading.vel_turns == pytest.approx((3.0, -4.0))


def test_a_drive_that_was_never_armed_is_where_its_count_says(rig: Rig, path: Path) -> None:
    rig.pos[[4, 5]] = 64.5, -2.25
    rig.step()
    driver = make_driver(path)
    first = rig.cycle(driver)
    rig.pos[4] = 64.75
    rig.cycle(driver)
    second = rig.cycle(driver)
    arm(rig, driver)
    third = rig.cycle(driver)
    driver.close()
    assert first.pos_turns == (64.5, -2.25)
    assert second.pos_turns == (64.75, -2.25)
    assert first.status == DriveStatus.IDLE
    assert third.pos_turns == pytest.approx((64.75, -2.25), abs=0.01)


def test_arming_brings_both_axes_to_closed_loop_torque_control(rig: Rig, path: Path) -> None:
    rig.bank.vel_limit[:] = 2.0
    rig.bank.current_lim[:] = 10.0
    rig.bank.input_torque[:] = 1.0
    driver = connected(rig, path)
    arm(rig, driver)
    driver.close()
    assert [rig.bank.state[axis] for axis in AXES] == [AxisState.CLOSED_LOOP_CONTROL] * 2
    assert rig.bank.state[3] == AxisState.IDLE
    assert rig.bank.vel_limit[[4, 5]] == pytest.approx(60.0)
    assert rig.bank.current_lim[[4, 5]] == pytest.approx(60.0)
    assert list(rig.bank.control_mode[[4, 5]]) == [1, 1]
    assert list(rig.bank.input_torque[[4, 5]]) == [0.0, 0.0]


def test_written_torque_reaches_the_right_axis_with_the_right_value(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    driver.write_torque((1.25, -0.5))
    torque = rig.step().copy()
    driver.close()
    assert list(torque[[4, 5]]) == [1.25, -0.5]
    assert not np.delete(torque, AXES).any()


def test_newest_of_several_written_torques_wins(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    for k in range(10):
        driver.write_torque((0.25 * k, -0.25 * k))
    torque = rig.step().copy()
    driver.close()
    assert list(torque[[4, 5]]) == [2.25, -2.25]


def test_written_torque_is_limited_and_not_a_number_is_zero(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    driver.write_torque((float("nan"), 1e300))
    torque = rig.step().copy()
    driver.close()
    assert torque[4] == 0.0
    assert torque[5] == pytest.approx(60.0 * 0.0827)


def test_newest_of_several_frames_in_one_packet_wins(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    ids = [arbitration_id(node, Command.GET_ENCODER_ESTIMATES) for node in NODES]
    rig.hub.broadcast(
        [
            (can_id, pack_two_floats(10.0 * k + i, 0.0))
            for k in range(3)
            for i, can_id in enumerate(ids)
        ]
    )
    reading = driver.read(0.5)
    driver.close()
    assert reading is not None
    assert reading.pos_turns == (20.0, 21.0)


def test_one_axis_alone_makes_no_sample_and_after_a_while_the_drive_is_lost(
    rig: Rig, path: Path
) -> None:
    driver = connected(rig, path)
    frame = (arbitration_id(NODES[0], Command.GET_ENCODER_ESTIMATES), pack_two_floats(1.0, 0.0))
    rig.hub.broadcast([frame])
    time.sleep(1.5 * DRIVE.watchdog_timeout)
    reading = driver.read(0.0)
    assert reading is not None
    assert reading.status == DriveStatus.LOST
    rig.hub.broadcast([(arbitration_id(NODES[1], Command.GET_ENCODER_ESTIMATES), frame[1])])
    reading = driver.read(0.5)
    driver.close()
    assert reading is not None
    assert reading.status == DriveStatus.IDLE


@pytest.mark.parametrize("fault", ["DISARM", "OVERSPEED", "DRV_FAULT", "ESTOP"])
def test_driver_reports_an_error_when_one_axis_disarms(rig: Rig, path: Path, fault: str) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    driver.write_torque((1.0, 1.0))
    rig.bank.inject("hip_right.axis1", fault)
    reading = rig.cycle(driver)
    assert rig.bank.state[4] == AxisState.CLOSED_LOOP_CONTROL
    driver.close()
    assert reading.status == DriveStatus.ERROR
    if fault == "DISARM":
        assert reading.error == 0
    else:
        assert reading.error != 0


def test_driver_arms_again_after_an_error(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    rig.bank.inject("hip_right.axis0", "DRV_FAULT")
    assert rig.cycle(driver).status == DriveStatus.ERROR
    arm(rig, driver)
    driver.close()


def test_going_idle_on_request_is_no_error(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    driver.idle()
    time.sleep((ARM_GRACE_MS + 5) * MS)
    reading = rig.cycle(driver)
    driver.close()
    assert reading.status == DriveStatus.IDLE
    assert [rig.bank.state[axis] for axis in AXES] == [AxisState.IDLE] * 2


def test_watchdog_of_a_drive_that_nobody_wrote_to_yet_is_no_error(path: Path) -> None:
    rig = Rig(path, watchdog=True)
    for _ in range(200):
        rig.step()
    assert rig.bank.heartbeat(4).axis_error == AxisError.WATCHDOG_TIMER_EXPIRED
    driver = connected(rig, path)
    arm(rig, driver)
    driver.close()
    rig.hub.close()


def test_watchdog_does_not_run_out_between_arming_and_the_heartbeat_that_shows_it(
    path: Path,
) -> None:
    rig = Rig(path, watchdog=True)
    driver = connected(rig, path)
    driver.arm(onboard=False)
    # 300 ms of the drives' time without a heartbeat.
    rig.front.receive()
    for _ in range(300):
        rig.bank.step(rig.now_s, rig.pos, rig.vel)
        rig.front.send_encoders()
        reading = driver.read(0.5)
        assert reading is not None
        assert reading.status == DriveStatus.IDLE
        rig.front.receive()
        rig.now_s += MS
    assert [rig.bank.state[axis] for axis in AXES] == [AxisState.CLOSED_LOOP_CONTROL] * 2
    driver.close()
    rig.hub.close()


def test_watchdog_that_disarms_a_running_axis_is_an_error(path: Path) -> None:
    rig = Rig(path, watchdog=True)
    driver = connected(rig, path)
    arm(rig, driver)
    for _ in range(150):
        rig.step()
    while (reading := driver.read(0.0)) is not None and reading.status == DriveStatus.ARMED:
        pass
    reading = rig.cycle(driver)
    driver.close()
    rig.hub.close()
    assert reading.status == DriveStatus.ERROR
    assert reading.error & AxisError.WATCHDOG_TIMER_EXPIRED


def test_driver_starts_without_a_bus_and_finds_it_later(path: Path) -> None:
    driver = make_driver(path)
    reading = driver.read(0.001)
    assert reading is not None
    assert reading.status == DriveStatus.LOST
    driver.write_torque((1.0, 1.0))
    driver.arm(onboard=False)
    driver.idle()
    assert driver.write_failures == 1
    rig = Rig(path)
    time.sleep(RETRY_MS * MS)
    driver.read(0.0)
    assert rig.cycle(driver).status == DriveStatus.IDLE
    arm(rig, driver)
    driver.close()
    rig.hub.close()


def test_driver_is_lost_with_its_hub_and_arms_again_with_a_new_one(path: Path) -> None:
    old = Rig(path)
    driver = connected(old, path)
    arm(old, driver)
    time.sleep(RETRY_MS * MS)
    old.hub.close()
    reading = driver.read(0.01)
    assert reading is not None
    assert reading.status == DriveStatus.LOST
    driver.write_torque((1.0, 1.0))
    new = Rig(path)
    time.sleep(RETRY_MS * MS)
    driver.read(0.0)
    assert driver.connections == 2
    # The new drive is in IDLE without having been asked: that is no state to go on from.
    assert new.cycle(driver).status == DriveStatus.ERROR
    arm(new, driver)
    driver.write_torque((0.5, 0.25))
    torque = new.step().copy()
    driver.close()
    new.hub.close()
    assert list(torque[[4, 5]]) == [0.5, 0.25]


def test_reconnected_driver_is_lost_until_heartbeats_tell_the_state(path: Path) -> None:
    rig = Rig(path)
    driver = make_driver(path)
    rig.front.receive()
    rig.bank.step(0.0, rig.pos, rig.vel)
    rig.front.send_encoders()
    reading = driver.read(0.5)
    driver.close()
    rig.hub.close()
    assert reading is not None
    assert reading.status == DriveStatus.LOST


def test_reading_from_a_silent_bus_is_none_at_first_and_lost_later(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    statuses = []
    for _ in range(20):
        reading = driver.read(0.004)
        statuses.append(None if reading is None else reading.status)
    driver.close()
    assert statuses[0] is None
    assert statuses[-1] == DriveStatus.LOST


def test_writing_to_a_hub_that_does_not_read_never_blocks_or_raises(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    for _ in range(5000):
        driver.write_torque((1.0, 2.0))
    driver.close()
    rig.front.receive()
    assert list(rig.bank.input_torque[[4, 5]]) == [1.0, 2.0]


def test_unknown_interface_is_refused_at_the_start() -> None:
    with pytest.raises(DriveError, match="no_such_bus"):
        OdriveCan(CanConfig(interface="no_such_bus", channel="x"), NODES, DRIVE)


def test_driver_runs_on_a_bus_with_nothing_but_the_api_of_python_can() -> None:
    config = CanConfig(interface="virtual", channel="test_odrive_can")
    driver = OdriveCan(config, NODES, DRIVE)
    with can.Bus(interface="virtual", channel="test_odrive_can", ignore_config=True) as drive_side:
        for node, pos in zip(NODES, (1.0, 2.0), strict=True):
            for command, data in (
                (Command.HEARTBEAT, struct.pack("<IBBBB", 0, 1, 0, 0, 0x80)),
                (Command.GET_ENCODER_ESTIMATES, struct.pack("<ff", pos, -pos)),
            ):
                can_id = arbitration_id(node, command)
                drive_side.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        reading = driver.read(0.5)
        driver.write_torque((0.5, -0.5))
        sent = [drive_side.recv(0.5), drive_side.recv(0.5)]
    driver.close()
    assert reading is not None
    assert reading.status == DriveStatus.IDLE
    assert reading.pos_turns == (1.0, 2.0)
    assert [message and (message.arbitration_id, bytes(message.data)) for message in sent] == [
        (0x08E, bytes.fromhex("0000003f")),
        (0x0AE, bytes.fromhex("000000bf")),
    ]


def ask(rig: Rig, client: UnixCanBus, command: Command) -> bytes:
    can_id = arbitration_id(NODES[1], command)
    client.send(can.Message(arbitration_id=can_id, is_extended_id=False, is_remote_frame=True))
    rig.front.receive()
    ((answer_id, data),) = client.recv_many(0.5)
    assert answer_id == can_id
    return data


def test_front_answers_requests_of_the_drives_registers(rig: Rig, path: Path) -> None:
    rig.pos[5] = -0.25
    with UnixCanBus(str(path)) as client:
        rig.front.receive()
        rig.bank.step(0.0, rig.pos, rig.vel)
        rig.bank.inject("hip_right.axis1", "OVERSPEED")
        assert ask(rig, client, Command.GET_ENCODER_ESTIMATES) == bytes(8)
        rig.bank.connected[:] = 1.0  # as after a first closed loop
        assert ask(rig, client, Command.GET_ENCODER_ESTIMATES) == struct.pack("<ff", -0.25, 0.0)
        assert ask(rig, client, Command.GET_ENCODER_COUNT) == struct.pack("<ii", -4096, 12288)
        assert ask(rig, client, Command.GET_MOTOR_ERROR) == struct.pack("<Q", 0x1_1000_0000)
        assert ask(rig, client, Command.GET_CONTROLLER_ERROR) == struct.pack("<II", 1, 0)
        assert ask(rig, client, Command.GET_VBUS) == struct.pack("<ff", 48.0, 0.0)


def test_front_sets_positions_and_gains_and_ignores_other_nodes(rig: Rig, path: Path) -> None:
    sent = [
        (arbitration_id(5, Command.SET_INPUT_POS), struct.pack("<fhh", 1.5, 250, -500)),
        (arbitration_id(5, Command.SET_POS_GAIN), struct.pack("<f", 30.0)),
        (arbitration_id(5, Command.SET_VEL_GAINS), struct.pack("<ff", 0.5, 0.0)),
        (arbitration_id(9, Command.SET_INPUT_TORQUE), struct.pack("<f", 9.0)),
        (arbitration_id(4, Command.SET_INPUT_TORQUE), b"\x01"),
    ]
    with UnixCanBus(str(path)) as client:
        client.send_many(
            [can.Message(arbitration_id=i, data=d, is_extended_id=False) for i, d in sent]
        )
        rig.front.receive()
    bank = rig.bank
    assert (bank.input_pos[5], bank.input_vel[5], bank.input_torque[5]) == (1.5, 0.25, -0.5)
    assert (bank.pos_gain[5], bank.vel_gain[5], bank.vel_integrator_gain[5]) == (30.0, 0.5, 0.0)
    assert not np.delete(bank.input_torque, [4, 5]).any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_an_estimate_that_is_no_number_is_no_sample(rig: Rig, path: Path, bad: float) -> None:
    driver = connected(rig, path)
    for node in NODES:
        can_id = arbitration_id(node, Command.GET_ENCODER_ESTIMATES)
        rig.hub.broadcast([(can_id, pack_two_floats(bad, 0.0))])
    assert driver.read(0.01) is None
    assert rig.cycle(driver).pos_turns == (0.0, 0.0), "the next good one counts"
    driver.close()


def test_a_link_that_fails_and_comes_back_at_once_is_no_lost_drive(path: Path) -> None:
    """An interface that restarts: the drive has held its last torque all the while."""
    rig = Rig(path)
    driver = connected(rig, path)
    arm(rig, driver)
    rig.hub.close()
    assert driver.read(0.0) is None, "silence, not yet lost"
    rig.hub = UnixCanHub(path)
    reading = driver.read(0.0)
    assert reading is None or reading.status != DriveStatus.LOST
    driver.close()
    rig.hub.close()
