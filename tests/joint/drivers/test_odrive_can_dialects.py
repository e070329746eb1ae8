"""Both firmwares behind one driver, on the emulated drives."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from services.joint.drivers.base import DriveStatus, MotorTarget
from services.joint.drivers.odrive_can import ARM_GRACE_MS, REBOOT_MS, RETRY_MS, OdriveCan
from services.simulator.cansimple_dialects import DialectName
from shared.can.cansimple import AxisError, AxisState
from shared.config.sections import CanConfig
from shared.exceptions import DriveError
from tests.joint.drivers.test_odrive_can import (
    AXES,
    DRIVE,
    MS,
    NODES,
    Rig,
    connected,
    make_driver,
    path,
)

__all__ = ["path"]  # fixtures

CLOSED = AxisState.CLOSED_LOOP_CONTROL
TARGET = MotorTarget((0.25, -0.5), (1.0, -2.0), (0.5, -0.25), (30.0, 40.0), (0.05, 0.06))


@pytest.fixture(params=["0.5", "0.6"])
def rig(request: pytest.FixtureRequest, path: Path) -> Iterator[Rig]:
    rig = Rig(path, dialect=request.param)
    yield rig
    rig.hub.close()


def spoken(rig: Rig) -> DialectName:
    return "0.6" if rig.front._dialect.sdo is not None else "0.5"


def arm(rig: Rig, driver: OdriveCan) -> None:
    driver.arm(onboard=True)
    time.sleep((ARM_GRACE_MS + 5) * MS)
    assert rig.cycle(driver).status is DriveStatus.ARMED


def test_the_driver_finds_out_which_firmware_speaks(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    assert driver.dialect == spoken(rig)
    assert driver.firmware == ((0, 6, 10) if spoken(rig) == "0.6" else None)
    driver.close()


def test_both_firmwares_arm_and_do_what_they_are_told(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    driver.write(TARGET)
    rig.step()
    bank, axes = rig.bank, list(AXES)
    assert [bank.state[axis] for axis in axes] == [CLOSED, CLOSED]
    np.testing.assert_allclose(bank.input_pos[axes], TARGET.pos_turns)
    np.testing.assert_allclose(bank.vel_gain[axes], TARGET.vel_gain, rtol=1e-6)
    driver.close()


@pytest.mark.parametrize("fault", ["DISARM", "OVERSPEED", "DRV_FAULT", "ESTOP", "WATCHDOG"])
def test_a_disarmed_axis_is_an_error_in_both_firmwares(rig: Rig, path: Path, fault: str) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    rig.bank.inject("hip_right.axis1", fault)
    reading = rig.cycle(driver)
    assert reading.status is DriveStatus.ERROR
    assert (reading.error == 0) == (fault == "DISARM")
    driver.close()


def test_the_same_fault_is_told_by_the_same_bit_whichever_firmware_speaks(
    rig: Rig, path: Path
) -> None:
    driver = connected(rig, path)
    arm(rig, driver)
    rig.bank.inject("hip_right.axis0", "WATCHDOG")
    assert rig.cycle(driver).error & AxisError.WATCHDOG_TIMER_EXPIRED
    driver.close()


def test_a_watchdog_that_ran_out_before_the_driver_came_is_no_error(rig: Rig, path: Path) -> None:
    for axis in ("hip_right.axis0", "hip_right.axis1"):
        rig.bank.inject(axis, "WATCHDOG")
    driver = connected(rig, path)
    assert rig.cycle(driver).error == 0
    arm(rig, driver)
    driver.close()


def test_a_drive_that_is_found_armed_is_found_so_in_both_firmwares(rig: Rig, path: Path) -> None:
    first = connected(rig, path)
    arm(rig, first)
    first.write(TARGET)
    rig.step()
    first.close()
    second = make_driver(path)
    statuses = set()
    for _ in range(5):
        reading = rig.cycle(second)
        statuses.add(reading.status)
    assert DriveStatus.ERROR not in statuses, "it would be armed anew, and drop the robot"
    assert reading.status is DriveStatus.ARMED
    assert reading.torque == pytest.approx(tuple(rig.bank.torque[list(AXES)]), abs=0.05)
    second.close()


def test_another_firmware_after_a_long_silence_is_found_out(path: Path) -> None:
    before = Rig(path, dialect="0.5")
    driver = connected(before, path)
    before.hub.close()
    driver.read(0.0)
    time.sleep((max(REBOOT_MS, RETRY_MS) + 50) * MS)
    driver.read(0.0)
    dialects: list[str] = [driver.dialect]
    after = Rig(path, dialect="0.6")
    time.sleep((RETRY_MS + 20) * MS)
    driver.read(0.0)
    after.cycle(driver)
    dialects.append(driver.dialect)
    assert dialects == ["", "0.6"]
    driver.close()
    after.hub.close()


def test_a_drive_that_restarts_within_the_silence_keeps_its_dialect(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    assert driver.read(0.0) is None
    assert driver.dialect == spoken(rig)
    driver.close()


# ---- where the motors are


def test_a_position_is_told_as_the_firmware_takes_it(rig: Rig, path: Path) -> None:
    driver = connected(rig, path)
    driver.set_position((64.25, -3.5))
    rig.step()
    driver.read(0.5)
    reading = rig.cycle(driver)
    assert reading.pos_turns == pytest.approx((64.25, -3.5), abs=1e-3)
    driver.close()


def test_no_position_is_told_while_the_firmware_is_not_known(path: Path) -> None:
    driver = make_driver(path)
    with pytest.raises(DriveError, match="which firmware"):
        driver.set_position((0.0, 0.0))
    driver.close()


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e9])
def test_what_is_no_position_is_not_told(rig: Rig, path: Path, bad: float) -> None:
    driver = connected(rig, path)
    with pytest.raises(DriveError, match="32 bits"):
        driver.set_position((1.0, 10.0 * bad))
    driver.close()


def test_a_position_that_no_bus_takes_is_an_error_that_names_the_nodes(
    rig: Rig, path: Path
) -> None:
    driver = connected(rig, path)
    rig.hub.close()
    driver.read(0.0)
    with pytest.raises(DriveError, match=f"{NODES[0]} and {NODES[1]}"):
        driver.set_position((0.0, 0.0))
    driver.close()


def test_counts_are_needed_by_0_5_only(rig: Rig, path: Path) -> None:
    driver = OdriveCan(CanConfig(interface="xrl_unix", channel=str(path)), NODES, DRIVE)
    rig.cycle(driver)
    if spoken(rig) == "0.5":
        with pytest.raises(DriveError, match="counts"):
            driver.set_position((1.0, 1.0))
    else:
        driver.set_position((1.0, 1.0))
    driver.close()
