"""odrive_can with the motors' own loops: what is written is what the emulated drive does."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drive_setpoint import DriveSetpointLaw
from services.joint.drivers.base import DriveStatus, MotorTarget
from services.joint.drivers.odrive_can import ARM_GRACE_MS, OdriveCan
from services.joint.drivers.resend_policy import DRIFT_MS, GAINS_MS
from services.joint.pd_law import Setpoint
from shared.can.cansimple import ControlMode
from tests.joint.drivers.test_odrive_can import (
    AXES,
    DRIVE,
    MS,
    Rig,
    connected,
    driver,
    make_driver,
    path,
    rig,
)

__all__ = ["driver", "path", "rig"]  # fixtures

N = 17.5
TARGET = MotorTarget((0.25, -0.5), (1.0, -2.0), (0.5, -0.25), (30.0, 40.0), (0.05, 0.06))


def arm(rig: Rig, driver: OdriveCan) -> None:
    driver.arm(onboard=True)
    time.sleep((ARM_GRACE_MS + 5) * MS)
    assert rig.cycle(driver).status is DriveStatus.ARMED


def test_arming_onboard_is_position_mode_without_gains_where_the_motors_are(
    rig: Rig, path: Path
) -> None:
    rig.pos[list(AXES)] = (1.5, -0.75)
    driver = connected(rig, path)
    arm(rig, driver)
    bank = rig.bank
    for axis, pos in zip(AXES, (1.5, -0.75), strict=True):
        assert bank.control_mode[axis] == ControlMode.POSITION
        assert bank.input_pos[axis] == pytest.approx(pos, abs=1e-4)
        assert (bank.pos_gain[axis], bank.vel_gain[axis]) == (0.0, 0.0)
        assert bank.vel_integrator_gain[axis] == 0.0
    assert not rig.step()[list(AXES)].any()
    driver.close()


def test_a_written_target_is_what_both_axes_are_given(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    driver.write(TARGET)
    rig.step()
    bank, axes = rig.bank, list(AXES)
    np.testing.assert_allclose(bank.input_pos[axes], TARGET.pos_turns)
    np.testing.assert_allclose(bank.input_vel[axes], TARGET.vel_turns)
    np.testing.assert_allclose(bank.input_torque[axes], TARGET.torque)
    np.testing.assert_allclose(bank.pos_gain[axes], TARGET.pos_gain, rtol=1e-6)
    np.testing.assert_allclose(bank.vel_gain[axes], TARGET.vel_gain, rtol=1e-6)
    assert not bank.vel_integrator_gain[axes].any()
    driver.close()


def test_the_joint_gets_the_same_torque_by_either_loop_to_rounding(rig: Rig, path: Path) -> None:
    """Over the wire, in the emulated firmware: thousandths of a newton metre at the motor."""
    driver = connected(rig, path)
    arm(rig, driver)
    law = DriveSetpointLaw(N, DRIVE.vel_limit)
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
                reading.t_ns, setpoint, (tau[0], tau[1]), reading.pos_turns, reading.vel_turns
            )
        )
        rig.front.receive()
        motors = rig.bank.step(rig.now_s, rig.pos, rig.vel)[list(AXES)]
        np.testing.assert_allclose(joint_torque((motors[0], motors[1]), N), tau, atol=0.05)
    driver.close()


def test_gains_that_were_lost_are_sent_again(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    driver.write(TARGET)
    rig.step()
    axes = list(AXES)
    for wait_ms in (DRIFT_MS, GAINS_MS):
        rig.bank.pos_gain[axes] = 1.0  # as if the frames had been lost
        time.sleep((wait_ms + 5) * MS)
        driver.write(TARGET)
        rig.step()
        np.testing.assert_allclose(rig.bank.pos_gain[axes], TARGET.pos_gain, rtol=1e-6)
    driver.close()


def test_a_drive_found_armed_tells_its_torques_until_it_is_taken_over(rig: Rig, path: Path) -> None:
    first = connected(rig, path)
    arm(rig, first)
    first.write(TARGET)
    held = rig.step()[list(AXES)].copy()
    assert np.abs(held).min() > 0.1
    first.close()
    second = make_driver(path)
    for _ in range(10):
        reading = rig.cycle(second)
    assert reading.status is DriveStatus.ARMED
    assert reading.torque is not None
    np.testing.assert_allclose(reading.torque, rig.bank.torque[list(AXES)], atol=0.05)
    second.write(TARGET)
    assert rig.cycle(second).torque is None
    second.close()


def test_our_own_arming_tells_no_torques(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    for _ in range(10):
        assert rig.cycle(driver).torque is None
    driver.close()
