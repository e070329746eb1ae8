"""Both firmwares behind one driver, on the emulated drives."""

from __future__ import annotations

import math
import time
from contextlib import nullcontext

import numpy as np
import pytest

from services.joint.drivers import odrive_can
from services.joint.drivers.can_link import RETRY_MS
from services.joint.drivers.frame_times import REBOOT_MS
from services.joint.drivers.odrive_can import OdriveCan
from services.simulator.fronts.cansimple_dialects import DialectName
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisError, AxisState
from shared.clock import NS_PER_MS
from shared.exceptions import DriveError
from tests.joint.drivers.rig import AXES, MS, NODES, TARGET, Rig, Shed, arm

CLOSED = AxisState.CLOSED_LOOP_CONTROL


@pytest.fixture(params=["0.5", "0.6"])
def dialect(request: pytest.FixtureRequest) -> DialectName:
    return "0.5" if request.param == "0.5" else "0.6"


@pytest.fixture
def rig(shed: Shed, dialect: DialectName) -> Rig:
    return shed.rig(dialect=dialect)


@pytest.mark.parametrize("fault", ["DISARM", "OVERSPEED", "DRV_FAULT", "ESTOP", "WATCHDOG"])
def test_a_disarmed_axis_is_an_error_and_armed_again(
    rig: Rig, driver: OdriveCan, fault: str
) -> None:
    arm(rig, driver, onboard=True)
    rig.bank.inject("hip_right.axis1", fault)
    reading = rig.cycle(driver)
    assert reading.status is DriveStatus.ERROR
    assert (reading.error == 0) == (fault == "DISARM")
    assert bool(reading.error & AxisError.WATCHDOG_TIMER_EXPIRED) == (fault == "WATCHDOG")
    goes_on = fault != "DRV_FAULT"  # the gate drivers share their fault line
    assert (rig.bank.state[AXES[0]] == CLOSED) == goes_on, "the joint service idles it"
    arm(rig, driver, onboard=True)


def test_a_drive_found_armed_tells_its_torques(rig: Rig, driver: OdriveCan, shed: Shed) -> None:
    arm(rig, driver, onboard=True)
    driver.write(TARGET)
    assert np.abs(rig.step()[list(AXES)]).min() > 0.1
    driver.close()
    second = shed.driver()
    readings = [rig.cycle(second) for _ in range(5)]
    statuses = [reading.status for reading in readings]
    assert DriveStatus.ERROR not in statuses, "it would be armed again, and drop the robot"
    assert statuses[-1] is DriveStatus.ARMED
    assert readings[-1].torque == pytest.approx(tuple(rig.bank.torque[list(AXES)]), abs=0.05)
    second.write(TARGET)
    assert rig.cycle(second).torque is None


def test_another_firmware_is_found_out_after_a_long_silence(shed: Shed) -> None:
    """A short one keeps the dialect."""
    before = shed.rig(dialect="0.5")
    driver = shed.connected(before)
    assert (driver.read(0.0), driver.dialect) == (None, "0.5")
    before.hub.close()
    driver.read(0.0)
    time.sleep((max(REBOOT_MS, RETRY_MS) + 50) * MS)
    driver.read(0.0)
    assert driver.dialect == ""
    after = shed.rig(dialect="0.6")
    time.sleep((RETRY_MS + 20) * MS)
    driver.read(0.0)
    after.cycle(driver)
    assert driver.dialect == "0.6"


def test_a_position_is_set_in_the_firmware_s_own_unit(rig: Rig, driver: OdriveCan) -> None:
    """One beyond the frame is refused, and one that is not sent names the nodes."""
    driver.set_position((64.25, -3.5))
    rig.step()
    driver.read(0.5)
    assert rig.cycle(driver).pos_turns == pytest.approx((64.25, -3.5), abs=1e-3)
    for bad in (math.nan, math.inf, 1e10):
        with pytest.raises(DriveError, match="32 bits"):
            driver.set_position((1.0, bad))
    rig.hub.close()
    driver.read(0.0)
    with pytest.raises(DriveError, match=f"{NODES[0]} and {NODES[1]}"):
        driver.set_position((0.0, 0.0))


def test_a_position_needs_a_known_firmware_and_counts_for_0_5(
    rig: Rig, shed: Shed, dialect: DialectName
) -> None:
    driver = shed.driver(counts_per_turn=None)
    with pytest.raises(DriveError, match="shown the firmware yet"):
        driver.set_position((0.0, 0.0))
    rig.cycle(driver)
    with pytest.raises(DriveError, match="counts") if dialect == "0.5" else nullcontext():
        driver.set_position((1.0, 1.0))


def test_temperatures_come_now_and_then_where_the_firmware_tells_them(
    rig: Rig, shed: Shed, dialect: DialectName, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(odrive_can, "HEAT_EVERY_NS", 20 * NS_PER_MS)
        driver = shed.connected(rig)
        readings = [rig.cycle(driver) for _ in range(100)]  # an answer may find mailboxes full
    found = [reading for reading in readings if reading.fet_celsius is not None]
    if dialect == "0.5":
        assert not found
        return
    assert found[0].fet_celsius == pytest.approx(tuple(rig.bank.heat.fet[list(AXES)]), abs=0.1)
    assert found[0].motor_celsius is None, "no thermistor is wired: 0 is no reading"
    after = [rig.cycle(driver).fet_celsius for _ in range(20)]
    assert after.count(None) >= 19
