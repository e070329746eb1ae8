"""The CAN driver on emulated drives, and on a bus whose every frame the test writes."""

from __future__ import annotations

import math
import time

import can
import msgspec
import numpy as np
import pytest

from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drive_setpoint import DriveGains, DriveSetpointLaw
from services.joint.drivers.base import MotorTarget
from services.joint.drivers.frame_times import ARM_GRACE_MS, INSIST_MS, REBOOT_MS
from services.joint.drivers.odrive_can import OdriveCan
from services.joint.pd_law import Setpoint
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisState, Command, ControlMode, arbitration_id, pack_two_floats
from tests.joint.drivers.can_bench import Bench
from tests.joint.drivers.rig import AXES, DRIVE, MS, NODES, TARGET, Rig, Shed, arm, read

CLOSED, IDLE = AxisState.CLOSED_LOOP_CONTROL, AxisState.IDLE

AWAY_FROM_ZERO = pack_two_floats(0.25, 0.0)
"""An estimate that is believed: at 0, 0 the driver asks for the count (`replies`)."""

ASK = Command.GET_ENCODER_COUNT
IDLING = [Command.SET_INPUT_TORQUE] * 2 + [Command.SET_AXIS_STATE] * 2

N = 17.5


def test_a_drive_that_was_never_armed_is_where_its_count_shows(rig: Rig, shed: Shed) -> None:
    rig.pos[[4, 5]] = 64.5, -2.25
    rig.step()
    driver = shed.driver()
    first = rig.cycle(driver)
    assert (first.pos_turns, first.vel_turns) == ((64.5, -2.25), (0.0, 0.0))
    assert first.status is DriveStatus.IDLE
    rig.pos[4] = 64.75
    rig.cycle(driver)
    assert rig.cycle(driver).pos_turns == (64.75, -2.25)
    arm(rig, driver)
    assert rig.cycle(driver).pos_turns == pytest.approx((64.75, -2.25), abs=0.01)


def test_arming_brings_both_axes_to_closed_loop_torque_control(rig: Rig, driver: OdriveCan) -> None:
    """Going idle on request is no error."""
    bank, axes = rig.bank, list(AXES)
    bank.vel_limit[:], bank.current_lim[:], bank.input_torque[:] = 2.0, 10.0, 1.0
    arm(rig, driver)
    assert (rig.states, bank.state[3]) == ([CLOSED] * 2, IDLE)
    for limits in (bank.vel_limit, bank.current_lim):
        assert limits[axes] == pytest.approx(60.0)
    assert list(bank.control_mode[axes]) == [1, 1]
    assert list(bank.input_torque[axes]) == [0.0, 0.0]
    driver.idle()
    time.sleep((ARM_GRACE_MS + 5) * MS)
    assert rig.cycle(driver).status == DriveStatus.IDLE
    assert rig.states == [IDLE] * 2


def test_a_written_torque_is_given(rig: Rig, driver: OdriveCan) -> None:
    """To the right axis; the newest wins; it is limited, and NaN is zero."""
    arm(rig, driver)
    for written, given in (
        ([(1.25, -0.5)], (1.25, -0.5)),
        ([(0.25 * k, -0.25 * k) for k in range(10)], (2.25, -2.25)),
        ([(math.nan, 1e300)], (0.0, 60.0 * 0.0827)),
    ):
        for torque in written:
            driver.write_torque(torque)
        motors = rig.step().copy()
        assert motors[list(AXES)] == pytest.approx(given)
        assert not np.delete(motors, AXES).any()


def test_one_axis_alone_makes_no_sample_and_is_lost(rig: Rig, shed: Shed) -> None:
    """As is a driver that has just connected, until heartbeats show the state."""
    driver = shed.driver()
    rig.front.receive()
    rig.bank.step(0.0, rig.pos, rig.vel)
    rig.front.send_encoders()
    assert read(driver).status is DriveStatus.LOST
    assert rig.cycle(driver).status == DriveStatus.IDLE
    for node, status in zip(NODES, (DriveStatus.LOST, DriveStatus.IDLE), strict=True):
        frame = arbitration_id(node, Command.GET_ENCODER_ESTIMATES), pack_two_floats(1.0, 0.0)
        rig.hub.broadcast([frame])
        if node == NODES[0]:
            time.sleep(1.5 * DRIVE.watchdog_timeout)
        assert read(driver, 0.0).status is status


def test_the_watchdog_is_fed_until_a_heartbeat_shows_the_arming(shed: Shed) -> None:
    rig = shed.rig(watchdog=True)
    driver = shed.connected(rig)
    driver.arm(onboard=False)
    rig.front.receive()
    for _ in range(300):  # ms of the drives' time, without a heartbeat
        rig.bank.step(shed.now_s, rig.pos, rig.vel)
        rig.front.send_encoders()
        assert read(driver).status is DriveStatus.IDLE
        rig.front.receive()
        shed.wait(MS)
    assert rig.states == [CLOSED] * 2


def test_no_frame_is_made_anew_in_a_cycle(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.armed()
    monkeypatch.setattr(bench.driver._link, "_send", len)
    made = []
    monkeypatch.setattr(can, "Message", lambda **_: made.append(1))
    for k in range(200):
        bench.wait(0.01)
        gains = {"pos_gain": (30.0 + k, 30.0), "vel_gain": (0.05, 0.05 + 1e-3 * k)}
        bench.driver.write(msgspec.structs.replace(TARGET, **gains))
        bench.driver.write_torque((0.1 * k, 0.0))
    assert (made, bench.driver.write_failures) == ([], 0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e300, 1e39])
@pytest.mark.parametrize("field", MotorTarget.__struct_fields__)
def test_a_target_that_is_no_number_is_not_sent(bench: Bench, field: str, bad: float) -> None:
    bench.armed()
    bench.driver.write(msgspec.structs.replace(TARGET, **{field: (0.0, bad)}))
    assert bench.commands() == []
    assert bench.driver.write_failures == 1


def test_arming_onboard_holds_the_positions_without_gains(rig: Rig, shed: Shed) -> None:
    rig.pos[list(AXES)] = (1.5, -0.75)
    arm(rig, shed.connected(rig), onboard=True)
    bank, axes = rig.bank, list(AXES)
    assert list(bank.control_mode[axes]) == [ControlMode.POSITION] * 2
    assert bank.input_pos[axes] == pytest.approx((1.5, -0.75), abs=1e-4)
    assert not np.any([bank.pos_gain[axes], bank.vel_gain[axes], bank.vel_integrator_gain[axes]])
    assert not rig.step()[axes].any()


def test_either_loop_gives_the_joint_the_same_torque(rig: Rig, driver: OdriveCan) -> None:
    """Over the wire, in the emulated firmware: thousandths of a newton metre at the motor."""
    arm(rig, driver, onboard=True)
    law, gains = DriveSetpointLaw(N, DRIVE.vel_limit), DriveGains()
    dice = np.random.default_rng(3)
    for _ in range(30):
        q = dice.uniform(-0.3, 0.3, 2)
        k_p, k_d = dice.uniform(0.0, 1500.0, 2), dice.uniform(1.0, 40.0, 2)
        q_ref = q + dice.uniform(-0.05, 0.05, 2)
        setpoint = Setpoint(
            (q_ref[0], q_ref[1]), (0.1, -0.2), (3.0, 4.0), (0.0, 0.0), (k_p[0], k_p[1]),
            (k_d[0], k_d[1]),
        )  # fmt: skip
        before = rig.pos.copy()
        for share in (*np.linspace(0.0, 1.0, 60), *[1.0] * 20):  # slowly: a jump is overspeed
            there = np.array(motor_from_joint((q[0], q[1]), N))
            rig.pos[list(AXES)] = (1.0 - share) * before[list(AXES)] + share * there
            reading = rig.cycle(driver)
        tau = tuple(dice.uniform(-50.0, 50.0, 2))
        driver.write(
            law.target(
                gains,
                reading.t_ns,
                setpoint,
                (tau[0], tau[1]),
                reading.pos_turns,
                reading.vel_turns,
            )
        )
        rig.front.receive()
        motors = rig.bank.step(rig.shed.now_s, rig.pos, rig.vel)[list(AXES)]
        np.testing.assert_allclose(joint_torque((motors[0], motors[1]), N), tau, atol=0.05)


def test_a_heartbeat_from_before_an_order_is_not_believed_after_it(bench: Bench) -> None:
    bench.receive()
    bench.driver.arm(onboard=True)
    for status, error in ((DriveStatus.IDLE, 0), (DriveStatus.ERROR, 0x40)):
        reading = bench.receive(AxisState.IDLE, error=0x40)
        assert (reading.status, reading.error) == (status, error)
        bench.wait(1e-3 * ARM_GRACE_MS)


def receive_heartbeat(bench: Bench, node: int, state: AxisState) -> None:
    """Have a node send a heartbeat, and both an estimate, 20 ms later."""
    bench.beat(node, state)
    for each in NODES:
        bench.send(each, Command.GET_ENCODER_ESTIMATES, AWAY_FROM_ZERO)
    bench.after(2 * ARM_GRACE_MS)


def test_an_axis_still_armed_after_idle_is_idled_again(bench: Bench) -> None:
    """Its sibling may have disarmed: two motors of a differential, and one of them pulls."""
    bench.armed()
    bench.driver.idle()
    assert bench.commands() == IDLING
    bench.receive(CLOSED)
    assert bench.commands() == [], "a heartbeat from before the order"
    receive_heartbeat(bench, NODES[0], IDLE)
    assert bench.commands() == [ASK]
    for _ in range(3):
        receive_heartbeat(bench, NODES[1], CLOSED)
        assert bench.commands() == IDLING
    receive_heartbeat(bench, NODES[1], IDLE)
    assert bench.commands() == [ASK]


@pytest.mark.parametrize("armed_again", [True, False])
def test_an_axis_that_was_armed_since_is_not_idled_again(bench: Bench, armed_again: bool) -> None:
    bench.armed()
    bench.driver.idle()
    if armed_again:
        bench.driver.arm(onboard=True)
    else:  # by somebody else, later
        bench.wait(1e-3 * INSIST_MS)
    bench.commands()
    receive_heartbeat(bench, NODES[0], CLOSED)
    assert Command.SET_AXIS_STATE not in bench.commands()


def test_estimates_without_heartbeats_are_a_lost_drive(bench: Bench) -> None:
    bench.armed()
    statuses = [bench.receive(None).status for _ in range(REBOOT_MS + 20)]
    assert statuses[: REBOOT_MS - 20] == [DriveStatus.ARMED] * (REBOOT_MS - 20)
    assert statuses[-10:] == [DriveStatus.LOST] * 10
    bench.receive(CLOSED)
    assert bench.receive(CLOSED).status is DriveStatus.ARMED


@pytest.mark.parametrize("silent", NODES)
def test_heartbeats_of_one_axis_do_not_count_for_the_other(bench: Bench, silent: int) -> None:
    bench.armed()
    sending = NODES[1 - NODES.index(silent)]
    for _ in range(2 * REBOOT_MS // (2 * ARM_GRACE_MS)):
        receive_heartbeat(bench, sending, CLOSED)
    assert bench.receive(None).status is DriveStatus.LOST
